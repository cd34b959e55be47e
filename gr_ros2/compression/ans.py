"""Entropy coding: a message is one big integer; symbols are pushed onto it and popped off again, last in, first out.

This is asymmetric numeral coding (J. Duda, arXiv:1311.2540) without its renormalisation: Python's integers are as long
as needed, so that a message of a few dozen symbols costs its information, rounded up to whole bytes once.

Invariants: for every ``push`` there is a ``pop`` that undoes it exactly; only integer arithmetic is used, so both ends
compute the same tables on every machine; a pop never fails, whatever the number (0 yields any number of zeros).
"""

from __future__ import annotations

from array import array
from collections.abc import Sequence

SCALE_BITS = 12
SCALE = 1 << SCALE_BITS
MASK = SCALE - 1


class Table:
    """A static model of one alphabet.

    :param weights: relative probability of each symbol; a symbol with 0 cannot be pushed
    :ivar codes: per symbol (start, share) in units of 1/4096
    :ivar slots: the symbol of each 12-bit slot
    """

    __slots__ = ("codes", "slots")

    def __init__(self, weights: Sequence[int]) -> None:
        total = sum(weights)
        shares = [max(1, weight * SCALE // total) if weight else 0 for weight in weights]
        # The rounding error is given to the likeliest symbols, where it costs least.
        order = sorted(range(len(shares)), key=lambda symbol: (-shares[symbol], symbol))
        excess = sum(shares) - SCALE
        for symbol in order:
            if excess == 0:
                break
            taken = min(excess, shares[symbol] - 1) if excess > 0 else excess
            shares[symbol] -= taken
            excess -= taken
        self.codes: list[tuple[int, int]] = []
        self.slots = array("H")
        for symbol, share in enumerate(shares):
            start = len(self.slots)
            self.codes.append((start, share))
            self.slots += array("H", (symbol,)) * share

    def push(self, x: int, symbol: int) -> int:
        """The number with a symbol on top of it.

        :param symbol: with a share; its index in ``weights``
        """
        start, share = self.codes[symbol]
        quotient, rest = divmod(x, share)
        return (quotient << SCALE_BITS) + rest + start

    def pop(self, x: int) -> tuple[int, int]:
        """(x, symbol)"""
        slot = x & MASK
        symbol = self.slots[slot]
        start, share = self.codes[symbol]
        return share * (x >> SCALE_BITS) + slot - start, symbol


_LENGTHS = Table([400, 300, 300, 300, 280, 260, 240, 220, *[160] * 8, *[60] * 16, *[16] * 33])
"""Model of bit lengths 0..64: small numbers are likelier."""
_RANKS = Table([700, 900, 800, 600, 400, 300, 200, 100, 60, 30, 10, 5, 3, 2, 1, 1])
"""Model of the bit lengths of rank + 1, from 1, for lists in order of frequency."""


def push_natural(x: int, value: int) -> int:
    """A number 0..2**64 - 1."""
    bits = value.bit_length()
    if bits > 1:
        x = x << (bits - 1) | (value ^ 1 << (bits - 1))
    return _LENGTHS.push(x, bits)


def pop_natural(x: int) -> tuple[int, int]:
    """(x, value), of what :func:`push_natural` has pushed."""
    x, bits = _LENGTHS.pop(x)
    if bits < 2:
        return x, bits
    bits -= 1
    return x >> bits, x & ((1 << bits) - 1) | 1 << bits


def push_rank(x: int, rank: int) -> int:
    """A place 0..65534 in a list whose first entries are the likeliest."""
    rank += 1
    bits = rank.bit_length() - 1
    return _RANKS.push(x << bits | (rank ^ 1 << bits), bits)


def pop_rank(x: int) -> tuple[int, int]:
    """(x, rank), of what :func:`push_rank` has pushed."""
    x, bits = _RANKS.pop(x)
    return x >> bits, (x & ((1 << bits) - 1) | 1 << bits) - 1


def to_bytes(x: int) -> bytes:
    """The shortest big-endian form; 0 is empty."""
    return x.to_bytes((x.bit_length() + 7) >> 3, "big")


def from_bytes(data: bytes) -> int:
    """The number of big-endian bytes; zeros before it change nothing."""
    return int.from_bytes(data, "big")
