"""Harnesses that throw arbitrary bytes at what must stand them: `python -m fuzz.wire` and so on."""
