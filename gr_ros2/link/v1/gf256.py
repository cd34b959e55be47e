"""Arithmetic in GF(256), and the coefficients of repairs.

The field is defined by the polynomial 0x11D (x^8 + x^4 + x^3 + x^2 + 1), and its generator is 2. Addition is XOR.
A body is multiplied by one ``bytes.translate`` with a table of 256 bytes, and added as one long integer. For bodies of
a packet's size, this is faster in Python than numpy.

Invariant: any square part of the Cauchy matrix ``coefficient(repair_id, number)`` is invertible if its repair ids
differ mod 128 and its numbers differ mod 128. So n missing packets can always be recovered from n different repairs.
"""

from __future__ import annotations

from collections.abc import Iterable

POLYNOMIAL = 0x11D
_HALF = 128


def _powers() -> tuple[list[int], list[int]]:
    powers, logarithms = [0] * 510, [0] * 256
    value = 1
    for exponent in range(255):
        powers[exponent] = powers[exponent + 255] = value
        logarithms[value] = exponent
        value <<= 1
        if value > 255:
            value ^= POLYNOMIAL
    return powers, logarithms


_POWER, _LOG = _powers()

TIMES: tuple[bytes, ...] = (
    bytes(256),
    *(bytes((0, *(_POWER[_LOG[a] + _LOG[b]] for b in range(1, 256)))) for a in range(1, 256)),
)
"""``body.translate(TIMES[a])`` is the body multiplied by a."""

INVERSE = bytes((0, *(_POWER[255 - _LOG[a]] for a in range(1, 256))))
"""1 / a for a in 1..255."""

CAUCHY: tuple[bytes, ...] = tuple(TIMES[a] for a in INVERSE)
"""The table of ``coefficient(repair_id, number)`` is ``CAUCHY[(128 + repair_id % 128) ^ number % 128]``."""


def coefficient(repair_id: int, number: int) -> int:
    """The factor of a source packet's body in a repair, 1..255.

    :param repair_id: of the repair
    :param number: number of the source packet
    """
    return INVERSE[(_HALF | repair_id % _HALF) ^ number % _HALF]


def combine(bodies: Iterable[tuple[int, bytes]], repair_id: int) -> bytes:
    """The linear combination of some bodies. It is as long as the longest body; shorter ones are padded with zeros.

    :param bodies: (number, body) of each
    :param repair_id: of the repair
    """
    shifted, as_integer = _HALF | repair_id % _HALF, int.from_bytes
    total = longest = 0
    for number, body in bodies:
        total ^= as_integer(body.translate(CAUCHY[shifted ^ number & _HALF - 1]), "little")
        if len(body) > longest:  # noqa: PLR1730 - max() would take a third of this loop's time
            longest = len(body)
    return total.to_bytes(longest, "little")
