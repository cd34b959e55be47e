"""The part of a message that is usually the same in the next one: frame names, covariance matrices, flags.

They are coded compactly and slowly; the codec caches the result, so that a message costs only a look-up unless its
static values are new.

Invariants: exact for all bytes; the result depends only on the message and the dictionary; a pop raises only
IndexError, for a word or constant that is not in the dictionary.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import cache
from struct import Struct

from gr_ros2.compression.ans import Table, pop_natural, pop_rank, push_natural, push_rank
from gr_ros2.compression.floats import KnownNumbers, class_table, pop_double, push_double
from gr_ros2.compression.layout import LONG_TEXT, MATRIX, SMALL, STRING, Slot

Value = bytes | int
"""A string with its terminator, or the length of a long one; a matrix, little endian; an octet."""

_KNOWN, _NUMBERED, _SPELLED, _OCTETS, _LONG = range(5)
_TEXTS = Table([2800, 400, 600, 60, 200])
STEMS = ("robot_", "robot", "r", "tb3_", "tb", "turtle", "turtlebot", "husky", "jackal", "uav", "drone", "ugv", "agent")
"""Names of robots in front of a number; they are part of the format, so new ones are only appended."""
_NUMBERED_TEXT = re.compile(rb"(/?)([a-z][a-z0-9]*?_?)([0-9]{1,6})([/_])(.+)", re.DOTALL)
_LETTERS = b"etaoinsrhldcumfpgwybvkxjqz_/0123456789.-~ ABCDEFGHIJKLMNOPQRSTUVWXYZ:,()[]{}<>=+*'\"!?#@%&|\\^$;`"
_SPELLING = Table([*[300] * 10, *[180] * 10, *[60] * 6, 250, 200, *[80] * 10, *[40] * 4, *[12] * (len(_LETTERS) - 42)])
_LETTER_RANK = {letter: rank for rank, letter in enumerate(_LETTERS)}

_ZERO, _AGAIN, _DIAGONAL, _SYMMETRIC, _FULL = range(5)
_MATRICES = Table([900, 1000, 1700, 300, 200])
_OTHER, _SAME = range(2)
_SAMENESS = Table([1400, 2700])
_OCTET = Table([1400, 800, 200, 120, 90, 70, 60, 50, *[10] * 56, *[3] * 191, 60])
_ENTRY_CLASS = "c"


class Words:
    """The strings of a dictionary in order of frequency, each with its terminator."""

    def __init__(self, words: Sequence[bytes]) -> None:
        self.words = tuple(words)
        self.ranks = {word: rank for rank, word in enumerate(words)}


def numbered(text: bytes) -> bool:
    """Whether a string begins with a known robot's name and number."""
    match = _NUMBERED_TEXT.fullmatch(text)
    return match is not None and match[2].decode() in STEMS


def push_static(values: Sequence[Value], slots: Sequence[Slot], words: Words, constants: KnownNumbers) -> int:
    """A state with all values pushed, so that they are popped in order."""
    x = 0
    last: dict[int, bytes] = {}
    again = []
    for value, slot in zip(values, slots, strict=True):
        again.append(slot.kind == MATRIX and last.get(slot.size) == value)
        if slot.kind == MATRIX and isinstance(value, bytes):
            last[slot.size] = value
    for value, slot, repeated in zip(reversed(values), reversed(slots), reversed(again), strict=True):
        if slot.kind == STRING:
            x = _push_text(x, value, words)
        elif isinstance(value, int):
            x = _OCTET.push(x, value)
        elif repeated:
            x = _MATRICES.push(x, _AGAIN)
        else:
            x = _push_matrix(x, value, slot.size, constants)
    return x


def pop_static(x: int, slots: Sequence[Slot], words: Words, constants: KnownNumbers) -> tuple[int, list[Value]]:
    """(x, values)"""
    values: list[Value] = []
    last: dict[int, bytes] = {}
    value: Value
    for slot in slots:
        if slot.kind == STRING:
            x, value = _pop_text(x, words)
        elif slot.kind == SMALL:
            x, value = _OCTET.pop(x)
        else:
            x, kind = _MATRICES.pop(x)
            if kind == _AGAIN:
                if slot.size not in last:
                    raise IndexError("no matrix to repeat")
                value = last[slot.size]
            else:
                x, value = _pop_matrix(x, kind, slot.size, constants)
                last[slot.size] = value
        values.append(value)
    return x, values


def _push_text(x: int, value: Value, words: Words) -> int:
    if isinstance(value, int):
        return _TEXTS.push(push_natural(x, value), _LONG)
    if (rank := words.ranks.get(value)) is not None:
        return _TEXTS.push(push_rank(x, rank), _KNOWN)
    match = _NUMBERED_TEXT.fullmatch(value)
    if match is not None and (rank := words.ranks.get(match[5])) is not None:
        stem = match[2].decode()
        if stem in STEMS and match[3] == b"%d" % int(match[3]):
            x = push_natural(push_rank(x, rank), int(match[3]))
            x = x << 2 | (match[4] == b"_") << 1 | (match[1] == b"/")
            return _TEXTS.push(push_rank(x, STEMS.index(stem)), _NUMBERED)
    if value[-1:] == b"\0" and all(letter in _LETTER_RANK for letter in value[:-1]):
        for letter in reversed(value[:-1]):
            x = _SPELLING.push(x, _LETTER_RANK[letter])
        return _TEXTS.push(push_natural(x, len(value) - 1), _SPELLED)
    x = x << 8 * len(value) | int.from_bytes(value, "big")
    return _TEXTS.push(push_natural(x, len(value)), _OCTETS)


def _pop_text(x: int, words: Words) -> tuple[int, Value]:
    x, kind = _TEXTS.pop(x)
    if kind == _KNOWN:
        x, rank = pop_rank(x)
        return x, words.words[rank]
    if kind == _NUMBERED:
        x, stem = pop_rank(x)
        slash, between = b"/" * (x & 1), b"_" if x & 2 else b"/"
        x, number = pop_natural(x >> 2)
        x, rank = pop_rank(x)
        return x, b"%s%s%d%s%s" % (slash, STEMS[stem].encode(), number, between, words.words[rank])
    x, length = pop_natural(x)
    if kind == _LONG:
        return x, length
    if length > LONG_TEXT:
        raise IndexError("a long string where a short one was announced")
    if kind == _OCTETS:
        return x >> 8 * length, (x & ((1 << 8 * length) - 1)).to_bytes(length, "big")
    text = bytearray()
    for _ in range(length):
        x, rank = _SPELLING.pop(x)
        text.append(_LETTERS[rank])
    return x, bytes(text) + b"\0"


@cache
def _matrix(side: int) -> tuple[Struct, Struct, tuple[int, ...], tuple[int, ...]]:
    """Structs of a matrix as bits and as floats, the indexes of its diagonal, and of its upper triangle."""
    size = side * side
    upper = tuple(side * row + column for row in range(side) for column in range(row, side))
    return Struct(f"<{size}Q"), Struct(f"<{size}d"), tuple(range(0, size, side + 1)), upper


def _push_matrix(x: int, value: bytes, side: int, constants: KnownNumbers) -> int:
    as_bits, as_reals, diagonal, upper = _matrix(side)
    bits, reals = as_bits.unpack(value), as_reals.unpack(value)
    if not any(bits):
        return _MATRICES.push(x, _ZERO)
    places: Sequence[int] = range(side * side)
    kind = _FULL
    if not any(v for place, v in enumerate(bits) if place % (side + 1)):
        kind, places = _DIAGONAL, diagonal
    elif all(bits[place] == bits[place % side * side + place // side] for place in upper):
        kind, places = _SYMMETRIC, upper
    table = class_table(_ENTRY_CLASS)
    before = [-1, *[bits[place] for place in places]]
    for n in range(len(places) - 1, -1, -1):
        if bits[places[n]] == before[n]:
            x = _SAMENESS.push(x, _SAME)
        else:
            x = push_double(x, bits[places[n]], reals[places[n]], table, constants)
            x = _SAMENESS.push(x, _OTHER) if n else x
    return _MATRICES.push(x, kind)


def _pop_matrix(x: int, kind: int, side: int, constants: KnownNumbers) -> tuple[int, bytes]:
    as_bits, _, diagonal, upper = _matrix(side)
    bits = [0] * (side * side)
    if kind == _ZERO:
        return x, as_bits.pack(*bits)
    places = {_DIAGONAL: diagonal, _SYMMETRIC: upper}.get(kind, range(side * side))
    table = class_table(_ENTRY_CLASS)
    value = 0
    for n, place in enumerate(places):
        same = _OTHER
        if n:
            x, same = _SAMENESS.pop(x)
        if same == _OTHER:
            x, value = pop_double(x, table, constants)
        bits[place] = value
        if kind == _SYMMETRIC:
            bits[place % side * side + place // side] = value
    return x, as_bits.pack(*bits)
