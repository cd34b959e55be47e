"""Lossless coding of floating point numbers: most bits of a double are noise, so all others must cost almost nothing.

A number is one of: zero; one of the dictionary's constants; a double that carries a float32; a short decimal fraction
(n / 10**k, k <= 9); the square of a short decimal fraction, as variances often are (in matrices); a sign and exponent
from the field's static model and the fraction bits; or, where none of these applies (NaN, infinities, denormals,
extreme exponents), all its bits.

Invariants: exact for all bit patterns, including NaN payloads and -0.0; each number is coded independently, except for
the four of a quaternion.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from struct import Struct

from gr_ros2.compression.ans import MASK, SCALE_BITS, Table, pop_natural, pop_rank, push_natural, push_rank

ZERO, CONSTANT, SINGLE, SHORT, SQUARE, VERBATIM, EXPONENTS = range(7)
"""Symbols of a field's model; from EXPONENTS on, sign and exponent: EXPONENTS + 2 * (exponent + 40) + sign."""
LOWEST, HIGHEST = -40, 23
"""Range of exponents in the models: 1e-12 .. 1.6e7."""
MAX_DECIMALS = 9

_POWERS = [10**k for k in range(MAX_DECIMALS + 1)]
_TEST_DECIMALS = 6
"""Numbers are tested for this many decimals; more are found only if the message was quantised finer."""
_U64, _F64, _U32, _F32 = Struct("<Q"), Struct("<d"), Struct("<I"), Struct("<f")
_FRACTION64, _FRACTION32 = (1 << 52) - 1, (1 << 23) - 1
_SINGLE_TAIL = (1 << 29) - 1
_DECIMALS = Table([160, 200, 200, 200, 120, 80, 80, 10, 10, 10])


@dataclass(frozen=True, slots=True)
class FloatClass:
    """What kind of numbers a field holds: shares of the symbols in 1/1000, the rest goes to exponents.

    :param centre: likeliest exponent; :param below: exponents down to half the likelihood, times two; :param above:
        the same upwards; :param minus: share of negative numbers, eighths;
        :param square: share of squares of short decimals, 0 = not looked for
    """

    zero: int
    constant: int
    single: int
    short: int
    centre: int
    below: int
    above: int
    minus: int = 4
    square: int = 0

    def table(self) -> Table:
        """The model of this class, of EXPONENTS + 2 * 64 symbols."""
        weights = [self.zero, self.constant, self.single, self.short, self.square, 2]
        exponents = [
            max(1, 4096 >> (2 * abs(e - self.centre) // (self.below if e < self.centre else self.above)))
            for e in range(LOWEST, HIGHEST + 1)
        ]
        total, share = sum(exponents), max(20, 1000 - sum(weights))
        weights = [weight * 10_000 for weight in weights]
        for weight in exponents:
            both = share * 10_000 * weight // total
            weights += [max(1, both * (8 - self.minus) // 8), max(1, both * self.minus // 8)]
        return Table(weights)


CLASSES: Mapping[str, FloatClass] = {
    "a": FloatClass(250, 60, 60, 80, 0, 6, 4),
    "n": FloatClass(960, 8, 4, 8, 0, 8, 4),
    "z": FloatClass(600, 30, 30, 40, -1, 5, 3),
    "p": FloatClass(20, 10, 15, 20, 5, 3, 3),
    "q": FloatClass(20, 10, 15, 20, 3, 3, 3),
    "u": FloatClass(30, 10, 15, 30, -1, 3, 1),
    "v": FloatClass(30, 10, 15, 30, 0, 2, 1, 1),
    "s": FloatClass(20, 5, 20, 20, -4, 3, 2),
    "t": FloatClass(20, 5, 20, 20, -7, 3, 2),
    "g": FloatClass(5, 5, 20, 20, 3, 1, 1, 1),
    "l": FloatClass(10, 5, 20, 30, 6, 3, 2, 3),
    "d": FloatClass(100, 100, 50, 650, 0, 6, 4),
    "f": FloatClass(40, 20, 850, 30, -2, 6, 4),
    "c": FloatClass(200, 500, 20, 100, 0, 6, 4, 2, 100),
}
"""Letter -> class, part of the format: a dictionary names one letter per field. "a" is for unknown fields."""
DEFAULT_CLASS = "a"


_CLASS_TABLES = {letter: made.table() for letter, made in CLASSES.items()}
"""Computed in advance, so that no message has to wait for a table."""


def class_table(letter: str) -> Table:
    """The model of a class (KeyError for an unknown letter)."""
    return _CLASS_TABLES[letter]


class KnownNumbers:
    """Values of doubles in order of frequency, by their bits."""

    def __init__(self, values: Sequence[int]) -> None:
        self.values = tuple(values)
        self.ranks = {value: rank for rank, value in enumerate(values)}


def bits_of(value: float) -> int:
    """The 64 bits of a double."""
    bits: int = _U64.unpack(_F64.pack(value))[0]
    return bits


def _decimal(value: float, bits: int) -> tuple[int, int] | None:
    """(n, k) with n / 10**k exactly this double and as few decimals as possible, None where there is none."""
    scaled = value * 1e6
    if not -1e15 < scaled < 1e15:
        return None
    n = round(scaled)
    if n == 0 or n / 1_000_000 != value:
        return None
    k = _TEST_DECIMALS
    while k and n % 10 == 0:
        n //= 10
        k -= 1
    return (n, k) if bits_of(n / _POWERS[k]) == bits else None


def _root(value: float) -> tuple[int, int] | None:
    """(n, k) with (n / 10**k)**2 exactly this positive double and n short, None where there is none."""
    if value <= 0.0:
        return None
    root = round(math.sqrt(value) * 1e6) / 1_000_000
    if root * root != value:
        return None
    short = _decimal(root, bits_of(root))
    return short if short is not None and short[0].bit_length() <= 24 else None


def push_double(x: int, bits: int, value: float, table: Table, constants: KnownNumbers) -> int:
    """Push a double given by its bits and its value."""
    if bits == 0:
        symbol = ZERO
    elif bits in constants.ranks:
        x = push_rank(x, constants.ranks[bits])
        symbol = CONSTANT
    elif (short := _decimal(value, bits)) is not None and (
        (size := short[0].bit_length()) <= 17 or (size <= 40 and bits & _SINGLE_TAIL)
    ):
        x = _push_short(x, *short)
        symbol = SHORT
    else:
        exponent = (bits >> 52 & 0x7FF) - 1023
        if table.codes[SQUARE][1] and LOWEST <= exponent <= HIGHEST and (root := _root(value)) is not None:
            x = _push_short(x, *root)
            symbol = SQUARE
        elif not LOWEST <= exponent <= HIGHEST:
            x = x << 64 | bits
            symbol = VERBATIM
        else:
            symbol = EXPONENTS + 2 * (exponent - LOWEST) + (bits >> 63)
            if bits & _SINGLE_TAIL:
                x = x << 52 | bits & _FRACTION64
            else:
                x = _PLAIN_EXPONENTS.push(x << 23 | (bits & _FRACTION64) >> 29, symbol)
                symbol = SINGLE
    start, share = table.codes[symbol]
    quotient, rest = divmod(x, share)
    return (quotient << SCALE_BITS) + rest + start


def pop_double(x: int, table: Table, constants: KnownNumbers) -> tuple[int, int]:
    """(x, bits)

    :raises IndexError: a constant that is not in the dictionary
    """
    slot = x & MASK
    symbol = table.slots[slot]
    start, share = table.codes[symbol]
    x = share * (x >> SCALE_BITS) + slot - start
    if symbol == ZERO:
        return x, 0
    if symbol >= EXPONENTS:
        symbol -= EXPONENTS
        head = (symbol & 1) << 63 | ((symbol >> 1) + LOWEST + 1023) << 52
        return x >> 52, head | x & _FRACTION64
    if symbol == CONSTANT:
        x, rank = pop_rank(x)
        return x, constants.values[rank]
    if symbol == SHORT:
        x, n, k = _pop_short(x)
        return x, bits_of(n / _POWERS[k])
    if symbol == SQUARE:
        x, n, k = _pop_short(x)
        return x, bits_of((n / _POWERS[k]) * (n / _POWERS[k]))
    if symbol == SINGLE:
        x, symbol = _PLAIN_EXPONENTS.pop(x)
        symbol -= EXPONENTS
        head = (symbol & 1) << 63 | ((symbol >> 1) + LOWEST + 1023) << 52
        return x >> 23, head | (x & _FRACTION32) << 29
    return x >> 64, x & 0xFFFF_FFFF_FFFF_FFFF


def push_single(x: int, bits: int, value: float, table: Table) -> int:
    """Push a float32 given by its bits and its value."""
    if bits == 0:
        return table.push(x, ZERO)
    exponent = (bits >> 23 & 0xFF) - 127
    if LOWEST <= exponent <= HIGHEST:
        n = round(value * 1e4)
        if -(1 << 17) < n < 1 << 17 and n and _U32.unpack(_F32.pack(n / 10_000))[0] == bits:
            k = 4
            while k and n % 10 == 0:
                n //= 10
                k -= 1
            return table.push(_push_short(x, n, k), SHORT)
        return table.push(x << 23 | bits & _FRACTION32, EXPONENTS + 2 * (exponent - LOWEST) + (bits >> 31))
    return table.push(x << 32 | bits, VERBATIM)


def pop_single(x: int, table: Table) -> tuple[int, int]:
    """(x, bits)

    :raises ValueError: a symbol that no float32 has
    """
    x, symbol = table.pop(x)
    if symbol == ZERO:
        return x, 0
    if symbol >= EXPONENTS:
        symbol -= EXPONENTS
        head = (symbol & 1) << 31 | ((symbol >> 1) + LOWEST + 127) << 23
        return x >> 23, head | x & _FRACTION32
    if symbol == SHORT:
        x, n, k = _pop_short(x)
        return x, _U32.unpack(_F32.pack(n / _POWERS[k]))[0]
    if symbol == VERBATIM:
        return x >> 32, x & 0xFFFF_FFFF
    raise ValueError(f"symbol {symbol} for a float32")


def _push_short(x: int, n: int, k: int) -> int:
    return _DECIMALS.push(push_natural(x << 1 | (n < 0), abs(n)), k)


def _pop_short(x: int) -> tuple[int, int, int]:
    x, k = _DECIMALS.pop(x)
    x, n = pop_natural(x)
    return x >> 1, -n if x & 1 else n, k


_PLAIN_EXPONENTS = Table([*[0] * EXPONENTS, *[1] * (2 * (HIGHEST - LOWEST + 1))])

_FREE, _IDENTITY, _PREDICTED, _PLANAR, _PLANAR_SIGNED = 0, 1, 2, 10, 14
_QUATERNIONS = Table([120, 200, 150, 60, 150, 60, 300, 100, 700, 120, 400, 150, 900, 400, 200])
"""Free; 0, 0, 0, 1; from _PREDICTED on 2 * (largest component) + its sign; from _PLANAR on the same - 4 where x and y
are zero (a turn about the vertical); the same with a minus before some zero."""
_MINUS_ZERO = 1 << 63
_MISSES = Table([900, 500, 250, 120, 60, 40, 20, 20, *[4] * 17])
"""Bit lengths of the zigzag distance between prediction and truth, in units in the last place."""
_LARGEST_MISS = 24
IDENTITY = (0, 0, 0, bits_of(1.0))


def push_quaternion(x: int, bits: Sequence[int], values: Sequence[float], table: Table, constants: KnownNumbers) -> int:
    """Push a unit quaternion: its largest component is predicted from the others, except for a few last bits."""
    if tuple(bits) == IDENTITY:
        return _QUATERNIONS.push(x, _IDENTITY)
    largest = max(range(4), key=lambda i: abs(values[i]))  # NaN: any index; the coded difference corrects it
    truth = bits[largest]
    if truth & _SINGLE_TAIL and truth not in constants.ranks:
        miss = (truth & ~(1 << 63)) - bits_of(_predicted(values, largest))
        miss = miss << 1 if miss >= 0 else ~(miss << 1)
        if (size := miss.bit_length()) <= _LARGEST_MISS:
            x = _MISSES.push(x << max(0, size - 1) | (miss ^ 1 << (size - 1) if size > 1 else 0), size)
            symbol = 2 * largest + (truth >> 63)
            if largest >= 2 and not (bits[0] | bits[1]) & ~_MINUS_ZERO:
                x = push_double(x, bits[5 - largest], values[5 - largest], table, constants)
                if not bits[0] | bits[1]:
                    return _QUATERNIONS.push(x, _PLANAR + symbol - 4)
                return _QUATERNIONS.push(x << 4 | (symbol - 4) << 2 | bits[0] >> 62 | bits[1] >> 63, _PLANAR_SIGNED)
            for i in _OTHERS[largest]:
                x = push_double(x, bits[i], values[i], table, constants)
            return _QUATERNIONS.push(x, _PREDICTED + symbol)
    for i in (3, 2, 1, 0):
        x = push_double(x, bits[i], values[i], table, constants)
    return _QUATERNIONS.push(x, _FREE)


def pop_quaternion(x: int, table: Table, constants: KnownNumbers) -> tuple[int, list[int]]:
    """(x, the bits of x, y, z, w)"""
    x, symbol = _QUATERNIONS.pop(x)
    if symbol == _IDENTITY:
        return x, list(IDENTITY)
    bits = [0, 0, 0, 0]
    if symbol == _FREE:
        for i in range(4):
            x, bits[i] = pop_double(x, table, constants)
        return x, bits
    if symbol < _PLANAR:
        largest, sign = divmod(symbol - _PREDICTED, 2)
        for i in reversed(_OTHERS[largest]):
            x, bits[i] = pop_double(x, table, constants)
    else:
        symbol -= _PLANAR
        if symbol == _PLANAR_SIGNED - _PLANAR:
            symbol, bits[0], bits[1] = x >> 2 & 3, (x >> 1 & 1) << 63, (x & 1) << 63
            x >>= 4
        largest, sign = 2 + (symbol >> 1), symbol & 1
        x, bits[5 - largest] = pop_double(x, table, constants)
    x, miss = _MISSES.pop(x)
    if miss > 1:
        size = miss - 1
        miss = x & ((1 << size) - 1) | 1 << size
        x >>= size
    miss = ~(miss >> 1) if miss & 1 else miss >> 1
    values = [_F64.unpack(_U64.pack(b))[0] for b in bits]
    bits[largest] = (bits_of(_predicted(values, largest)) + miss) % (1 << 63) | sign << 63
    return x, bits


_OTHERS = ((1, 2, 3), (0, 2, 3), (0, 1, 3), (0, 1, 2))


def _predicted(values: Sequence[float], largest: int) -> float:
    a, b, c = (values[i] for i in _OTHERS[largest])
    rest = 1.0 - (a * a + b * b + c * c)
    return math.sqrt(rest) if rest > 0.0 else 0.0
