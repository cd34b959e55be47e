"""From a shape to a compiled layout: one ``struct`` call splits a message, one packs it.

An *outline* holds for all messages of a type with the same sequence lengths: which values there are and how each is
coded. A *layout* adds the lengths of the strings, which fixes every offset.

Invariants: alignment gaps are skipped on the way in and zero on the way out; values are read as bits, never as floats,
so that every NaN survives; how a value is coded depends only on the type and on sequence lengths, which the decoder
knows.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from operator import itemgetter
from struct import Struct
from typing import Any

from gr_ros2.compression.schema import (
    HEADER,
    MAX_PARTS,
    QUATERNION_TYPE,
    SIZES,
    TIME_TYPES,
    Composite,
    Node,
    Repeat,
    Scalar,
    Shape,
    Text,
)

MAX_SLOTS = 640
"""Most values that are coded one by one; a message with more is not split, which bounds the time at both ends."""
MAX_CODED_ITEMS = 5 * MAX_SLOTS
"""No message of MAX_SLOTS values has more items (a quaternion has four)."""
FEW = 16
"""Arrays of numbers up to this length are coded one by one, longer ones in bulk."""
LONG_TEXT = 64
"""Strings of more bytes are coded in bulk with the arrays."""
MATRICES = {9: 3, 36: 6}
"""Fixed float64 arrays of these lengths are treated as square matrices: length -> side."""

TIME, QUATERNION, DOUBLE, SINGLE, INTEGER, OCTETS, BULK = range(7)
"""Live values: they differ from message to message."""
STRING, MATRIX, SMALL = range(3)
"""Static values: usually the same as in the message before, so that the coded result is cached (the bytes are always
sent)."""

_BITS = {"d": "Q", "f": "I"}


@dataclass(slots=True)  # not frozen: frozen instances would make the preparation of a new message a third slower
class Slot:
    """One value to code. Never modified.

    :param index: of its (first) item
    :param real: of its (first) item among the floats, -1 for none; BULK: 0 for floats
    :param size: bytes of an element (BULK), side (MATRIX), bytes (OCTETS), bytes or minus bytes if signed (INTEGER)
    :param path: member names from the top, ``[]`` for an element: ``transforms[].header.frame_id``
    """

    kind: int
    index: int
    real: int
    size: int
    path: str


@dataclass(slots=True)
class Outline:
    """How all messages with the same sequence lengths are coded.

    :ivar items: struct code and alignment of each item; code '' = a string, whose length only the layout knows
    """

    items: list[tuple[str, int, int]] = field(default_factory=lambda: [("4s", 1, 4)])
    """(code, alignment, size); item 0 is the encapsulation header"""
    live: list[Slot] = field(default_factory=list)
    static_values: list[Slot] = field(default_factory=list)
    lengths: list[int] = field(default_factory=list)
    """Indexes of the lengths of strings and sequences, in order of appearance."""
    counts: dict[int, int] = field(default_factory=dict)
    """Values of those that belong to sequences, by index."""
    reals: int = 0
    max_items: int = 4 * MAX_PARTS

    @property
    def codable(self) -> bool:
        """Whether the values are few enough to be coded one by one."""
        return len(self.live) + len(self.static_values) <= MAX_SLOTS

    @property
    def bulk(self) -> list[Slot]:
        """The long arrays, which go into the second part."""
        return [slot for slot in self.live if slot.kind == BULK]


def outline(tree: Composite, counts: Iterable[int], max_items: int = 4 * MAX_PARTS) -> Outline | None:
    """The outline for given sequence lengths; None where there would be more items."""
    made = Outline(max_items=max_items)
    try:
        _add(made, tree, "", iter(counts))
    except OverflowError:
        return None
    return made


def _add(made: Outline, node: Node, path: str, counts: Iterator[int]) -> None:
    if len(made.items) > made.max_items:
        raise OverflowError
    if isinstance(node, Scalar):
        _add_number(made, node.code, path)
    elif isinstance(node, Text):
        made.lengths.append(len(made.items))
        made.items.append(("I", 4, 4))
        made.static_values.append(Slot(STRING, len(made.items), -1, 0, path))
        made.items.append(("", 1, 0))
    elif isinstance(node, Repeat):
        _add_repeat(made, node, path, counts)
    elif node.type_name in TIME_TYPES:
        made.live.append(Slot(TIME, len(made.items), -1, 0, path))
        made.items += [("I", 4, 4)] * 2
    elif node.type_name == QUATERNION_TYPE:
        made.live.append(Slot(QUATERNION, len(made.items), made.reals, 0, path))
        made.items += [("d", 8, 8)] * 4
        made.reals += 4
    else:
        for name, member in node.members:
            _add(made, member, f"{path}.{name}" if path else name, counts)


def _add_number(made: Outline, code: str, path: str) -> None:
    size, index = SIZES[code], len(made.items)
    made.items.append((code, size, size))
    if code == "B":
        made.static_values.append(Slot(SMALL, index, -1, 1, path))
    elif code in "df":
        made.live.append(Slot(DOUBLE if code == "d" else SINGLE, index, made.reals, size, path))
        made.reals += 1
    else:
        made.live.append(Slot(INTEGER, index, -1, -size if code.islower() else size, path))


def _add_repeat(made: Outline, node: Repeat, path: str, counts: Iterator[int]) -> None:
    fixed, count = node.count, node.count
    if count is None:
        count = next(counts)
        made.lengths.append(len(made.items))
        made.counts[len(made.items)] = count
        made.items.append(("I", 4, 4))
    if not isinstance(node.element, Scalar):
        for _ in range(count):
            _add(made, node.element, path + "[]", counts)
        return
    if not count:
        return
    code = node.element.code
    size, index = SIZES[code], len(made.items)
    if code != "B" and count <= FEW and not (code == "d" and fixed in MATRICES):
        for _ in range(count):
            _add_number(made, code, path + "[]")
        return
    made.items.append((f"{size * count}s", size, size * count))
    if code == "d" and fixed in MATRICES:
        made.static_values.append(Slot(MATRIX, index, -1, MATRICES[count], path))
    elif size * count <= FEW:
        made.live.append(Slot(OCTETS, index, -1, count, path))
    else:
        made.live.append(Slot(BULK, index, 0 if code in "df" else -1, size, path))


class Layout:
    """An outline with every offset known.

    :ivar size: bytes of the payload, encapsulation header and tail included
    """

    def __init__(self, plan: Outline, shape: Shape, header: bytes) -> None:
        self.outline, self.shape, self.header = plan, shape, header
        texts = iter(shape.texts)
        bits, reals = [shape.order], [shape.order]
        at = -HEADER
        expected: list[Any] = [header]
        length_indexes = set(plan.lengths)
        for index, (code, alignment, size) in enumerate(plan.items):
            if size > 0 and (gap := -at % alignment):
                bits.append(f"{gap}x")
                reals.append(f"{gap}x")
                at += gap
            if index in length_indexes:
                expected.append(plan.counts[index] if index in plan.counts else next(texts))
            if not code:
                size = expected[-1]  # noqa: PLW2901 - a string's size stands in the item before it
                code = f"{size}s"  # noqa: PLW2901
            bits.append(_BITS.get(code, code))
            reals.append(code if code in _BITS else f"{size}x")
            at += size
        bits.append(f"{shape.tail}s")
        expected.append(bytes(shape.tail))
        self.long_texts = {
            index + 1: length
            for index, length in zip(plan.lengths, expected[1:-1], strict=True)
            if index not in plan.counts and length > LONG_TEXT
        }
        """Index -> length of the strings that are coded in bulk."""
        self._bits = Struct("".join(bits))
        self.size = self._bits.size
        self.pack = self._bits.pack
        self.unpack = self._bits.unpack
        self.unpack_reals = Struct("".join(reals) + f"{shape.tail}x").unpack
        self._picked = itemgetter(0, *plan.lengths, len(plan.items))
        self._expected = tuple(expected)

    def fits(self, values: tuple[Any, ...]) -> bool:
        """Whether values unpacked by this layout have its shape."""
        return bool(self._picked(values) == self._expected)

    def normalised(self, payload: bytes) -> bytes:
        """The payload with its alignment gaps set to zero."""
        return self.pack(*self.unpack(payload))
