"""Limits of a coded message: the size of the decoded message and the number of its parts, by the number of coded bytes.

The coded bytes are counted without those that name codec and dictionary.

Invariants: the limits are part of the format, so both ends compute the same; every limit depends only on the length of
the coded message, so that a short message costs its receiver little, whatever it claims. A sender pads a coded message
that would be too short for its content (``least``).
"""

from __future__ import annotations

FREE_SIZE, SIZE_PER_BYTE = 1 << 16, 1 << 12
"""Bytes of a decoded message: a base value, and an additional number for each coded byte."""
FREE_ITEMS, ITEMS_PER_BYTE = 64, 4
"""Items (numbers, string lengths, strings) in sequences: a base value, and an additional number for each coded byte."""


def largest(coded: int) -> int:
    """Most bytes of a message with ``coded`` coded bytes."""
    return FREE_SIZE + SIZE_PER_BYTE * coded


def most_items(coded: int) -> int:
    """Most items in sequences of a message with ``coded`` coded bytes."""
    return FREE_ITEMS + ITEMS_PER_BYTE * coded


def least(size: int, items: int = 0) -> int:
    """Fewest coded bytes of a message with ``size`` bytes and ``items`` items in sequences."""
    return max(0, -(-(size - FREE_SIZE) // SIZE_PER_BYTE), -(-(items - FREE_ITEMS) // ITEMS_PER_BYTE))
