"""Counters that wrap around on the wire."""

from __future__ import annotations


def unwrap(low: int, least: int, bits: int) -> int:
    """The smallest number, not below ``least``, with the lowest bits that the wire carries.

    A counter may be up to ``n`` behind the newest number seen; then ``least = newest - n``. Numbers up to
    ``2**bits - 1 - n`` ahead of the newest are then told apart from numbers behind it.

    :param low: as received, 0..2**bits - 1
    :param bits: width on the wire
    :return: ``least`` .. ``least + 2**bits - 1``
    """
    return least + (low - least & (1 << bits) - 1)
