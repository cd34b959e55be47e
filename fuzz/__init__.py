"""Harnesses that throw arbitrary bytes at what must stand them: `python -m fuzz.NAME`, one for each module here."""
