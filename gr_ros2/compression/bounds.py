"""How much a coded message may stand for: the more bytes came, the more may come out, and the more parts it may have.

Invariants: part of the format, so both ends reckon alike; every bound grows with the length of the coded message and
with nothing else that it says, so that a short message costs its receiver little whatever it claims. A sender whose
message comes out too short for what it stands for makes it longer (``least``).
"""

from __future__ import annotations

FREE_SIZE, SIZE_PER_BYTE = 1 << 16, 1 << 12
"""Bytes of a message that any coded message may have, and more for each byte of it."""
FREE_ITEMS, ITEMS_PER_BYTE = 64, 4
"""Items (numbers, string lengths, strings) in sequences that any coded message may have, and more for each byte."""


def largest(coded: int) -> int:
    """Bytes of a message that so many coded bytes may become."""
    return FREE_SIZE + SIZE_PER_BYTE * coded


def most_items(coded: int) -> int:
    """Items in sequences that so many coded bytes may stand for."""
    return FREE_ITEMS + ITEMS_PER_BYTE * coded


def least(size: int, items: int = 0) -> int:
    """Coded bytes that a message of so many bytes, with so many items in sequences, needs."""
    return max(0, -(-(size - FREE_SIZE) // SIZE_PER_BYTE), -(-(items - FREE_ITEMS) // ITEMS_PER_BYTE))
