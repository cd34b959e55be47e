"""The key of a version 1 message: it identifies the message among all messages of its sender.

Invariant: no two messages of a sender have the same key, even across restarts.
"""

from __future__ import annotations

from typing import NamedTuple


class Key(NamedTuple):
    """Key of a message of one sender: boot number, number of the packet in which it began, place among its entries."""

    boot: int
    number: int
    place: int
