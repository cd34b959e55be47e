"""What a run leaves behind: the ledger of its messages, their times, its numbers; as values and as files."""
