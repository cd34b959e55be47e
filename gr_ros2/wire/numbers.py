"""Numbers that come round on the wire, and what they count."""

from __future__ import annotations


def unwrap(low: int, least: int, bits: int) -> int:
    """The number not below ``least`` of which the wire says the lowest bits.

    A counter that may be up to ``n`` behind the newest number seen has ``least = newest - n``; then up to
    ``2**bits - 1 - n`` ahead of it is told apart from behind.

    :param low: as received, 0..2**bits - 1
    :param bits: width on the wire
    :return: ``least`` .. ``least + 2**bits - 1``
    """
    return least + (low - least & (1 << bits) - 1)
