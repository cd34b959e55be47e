"""The data of a run: the ledger of its messages, their times and its numbers, as values and as files."""
