"""What names a message of version 1 among all messages of its sender.

Invariant: no two messages of a sender have the same key, over all its starts.
"""

from __future__ import annotations

from typing import NamedTuple


class Key(NamedTuple):
    """A message of one sender: boot number, number of the packet in which it began, place among the entries there."""

    boot: int
    number: int
    place: int
