"""The codec ``fields``: a message is split by its type, and each value is coded according to its kind.

A message becomes one number (see ``ans``). Popping it yields, in order: byte order, options and tail; sequence lengths;
live values (stamps, numbers). The rest of the number is the static values (strings, matrices, flags), so they can be
cached with that number as the key. Long arrays and strings follow as a second part.

Invariants: exact except for alignment gaps, which become zero; no message needs another; caches only save time; memory
is bounded; decoding arbitrary bytes gives a message or a DamagedError.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from itertools import repeat
from typing import Any, NamedTuple, TypeVar

from gr_ros2.compression import bounds, bulk
from gr_ros2.compression.ans import Table, from_bytes, pop_natural, push_natural, to_bytes
from gr_ros2.compression.floats import (
    pop_double,
    pop_quaternion,
    pop_single,
    push_double,
    push_quaternion,
    push_single,
)
from gr_ros2.compression.layout import (
    DOUBLE,
    INTEGER,
    MATRIX,
    MAX_CODED_ITEMS,
    OCTETS,
    QUATERNION,
    SINGLE,
    STRING,
    TIME,
    Layout,
    outline,
)
from gr_ros2.compression.prepared import PARTS, TEMPLATES, Model, Prepared
from gr_ros2.compression.schema import BIG, LITTLE, MAX_PARTS, Composite, Node, Repeat, Shape, is_open, shape_of
from gr_ros2.compression.static_values import Value, pop_static, push_static
from gr_ros2.compression.zstd_frames import Zstd, read_varint
from gr_ros2.core.errors import DamagedError
from gr_ros2.wire import varint

MAX_NUMBER = 8192
"""Bytes of the number part: the most that MAX_SLOTS values can need; a longer number is damage."""
_REMEMBERED = 128
"""Entries of each cache."""
_LAYOUTS_TRIED = 4

_HEADERS = [bytes((0, order, 0, options)) for order in (1, 0) for options in range(4)]
_HEADS = Table([3000, *[150] * 3, *([20, 40, 40, 40] * 3), *[4] * 16])
"""Symbol: 4 * (index of the header) + tail; little endian without options and tail is by far the likeliest."""
_RAW, _ZSTD = range(2)
_BLOB = Table([1, 3])

_K = TypeVar("_K")
_V = TypeVar("_V")
_FULL_STAMP, _ZERO_STAMP, _MS_STAMP, _YOUNG, _YOUNG_MS, _ANY_STAMP = range(6)
_STAMPS = Table([3000, 200, 200, 350, 250, 90])
_ERA = 1_200_000_000
"""Stamps 2008 .. 2042 need 30 bits for the second, simulated ones below 2**20 need 20."""
_ERA_BITS, _YOUNG_BITS = 30, 20
_SECOND, _MS = 1_000_000_000, 1_000_000


def push_stamp(x: int, sec: int, nanosec: int) -> int:
    """Push a stamp or a duration.

    :param sec, nanosec: 0..2**32 - 1, the bits of the fields whatever their sign
    """
    if not sec and not nanosec:
        return _STAMPS.push(x, _ZERO_STAMP)
    if nanosec < _SECOND:
        era = sec - _ERA
        if 0 <= era < 1 << _ERA_BITS:
            if nanosec % _MS == 0:
                return _STAMPS.push((x << _ERA_BITS | era) * 1000 + nanosec // _MS, _MS_STAMP)
            return _STAMPS.push((x << _ERA_BITS | era) * _SECOND + nanosec, _FULL_STAMP)
        if sec < 1 << _YOUNG_BITS:
            if nanosec % _MS == 0:
                return _STAMPS.push((x << _YOUNG_BITS | sec) * 1000 + nanosec // _MS, _YOUNG_MS)
            return _STAMPS.push((x << _YOUNG_BITS | sec) * _SECOND + nanosec, _YOUNG)
    return _STAMPS.push(x << 64 | sec << 32 | nanosec, _ANY_STAMP)


def pop_stamp(x: int) -> tuple[int, int, int]:
    """(x, sec, nanosec)"""
    x, symbol = _STAMPS.pop(x)
    if symbol == _ZERO_STAMP:
        return x, 0, 0
    if symbol == _ANY_STAMP:
        return x >> 64, x >> 32 & 0xFFFF_FFFF, x & 0xFFFF_FFFF
    if symbol in (_MS_STAMP, _YOUNG_MS):
        x, nanosec = divmod(x, 1000)
        nanosec *= _MS
    else:
        x, nanosec = divmod(x, _SECOND)
    if symbol in (_FULL_STAMP, _MS_STAMP):
        return x >> _ERA_BITS, (x & ((1 << _ERA_BITS) - 1)) + _ERA, nanosec
    return x >> _YOUNG_BITS, x & ((1 << _YOUNG_BITS) - 1), nanosec


class _Array(NamedTuple):
    """A piece of the second part: item, bytes, bytes of an element, and its transform."""

    item: int
    length: int
    size: int
    way: int
    parameter: int


class FieldsCodec:
    """Codes the messages of one type.

    :param tree: the type
    """

    def __init__(self, tree: Composite, model: Model, zstd: Zstd) -> None:
        self._tree, self._model, self._zstd = tree, model, zstd
        self._open = tree.open
        empty = outline(tree, repeat(0), MAX_CODED_ITEMS)
        self._fixed = len(empty.items) if empty is not None and empty.codable else None
        """Items of a message whose sequences are empty; None where no message of the type can be coded."""
        self._recent: dict[int, list[Layout]] = {}
        self._layouts: dict[tuple[tuple[int, ...], tuple[int, ...], bytes, int], Layout] = {}
        self._prepared: dict[tuple[int, ...], Prepared] = {}
        self._coded: dict[tuple[Any, ...], int] = {}
        self._values: dict[tuple[tuple[int, ...], int], tuple[Value, ...]] = {}

    def layout(self, payload: bytes) -> tuple[Layout, tuple[Any, ...]] | None:
        """The layout of a payload and its values; None where it is not a message of the type, or has too many parts."""
        recent = self._recent.get(len(payload))
        if recent is not None:
            for layout in recent:
                values = layout.unpack(payload)
                if layout.fits(values):
                    return layout, values
        shape = shape_of(payload, self._tree)
        if shape is None or payload[:4] not in _HEADERS:
            return None
        found = self._layout(shape, payload[:4])
        if found is None or found.size != len(payload):
            return None
        if recent is None:
            recent = _remember(self._recent, len(payload), [])
        recent.insert(0, found)
        del recent[_LAYOUTS_TRIED:]
        return found, found.unpack(payload)

    def encode(self, payload: bytes) -> tuple[bytes, bool] | None:
        """The coded message, and whether it has a second part; None where the payload cannot be split."""
        found = self.layout(payload)
        if found is None:
            return None
        layout, values = found
        prepared = self._prepare(layout.shape.counts)
        if prepared is None or not prepared.codable or self._fixed is None:
            return None
        blob = b""
        ways: list[tuple[int, int]] = []
        packed = _RAW
        if prepared.bulk or layout.long_texts:
            blob, ways, packed = self._blob(layout, prepared, values)
        x = self._push_static(prepared, layout, values)
        x = self._push_live(x, prepared, values, layout.unpack_reals(payload), ways)
        if self._open:
            for count in reversed(layout.shape.counts):
                x = push_natural(x, count)
        if blob:
            x = _BLOB.push(x, packed)
        x = _HEADS.push(x, 4 * _HEADERS.index(layout.header) + layout.shape.tail)
        number = to_bytes(x)
        if len(number) > MAX_NUMBER:
            return None
        wanted = bounds.least(layout.size, len(prepared.plan.items) - self._fixed)
        number = number.rjust(wanted - len(blob), b"\0")
        return (varint(len(number)) + number + blob, True) if blob else (number, False)

    def decode(self, coded: bytes, with_blob: bool, max_size: int) -> bytes:
        """The message.

        :param max_size: most bytes of the message
        :raises DamagedError: not a coded message, or a message larger than ``max_size``
        """
        try:
            return self._decode(coded, with_blob, max_size)
        except (IndexError, ValueError, OverflowError, struct.error) as error:
            if isinstance(error, DamagedError):
                raise
            raise DamagedError(f"damaged message: {' '.join(str(error).split())}") from error

    def static_values(self, payload: bytes) -> tuple[tuple[int, ...], int] | None:
        """The template of this message (``Model.templates``); None where it cannot use one."""
        found = self.layout(payload)
        if found is None or found[0].long_texts or (prepared := self._prepare(found[0].shape.counts)) is None:
            return None
        values = self._static_values(prepared, *found)
        return found[0].shape.counts, push_static(
            values, prepared.plan.static_values, self._model.words, self._model.constants
        )

    # Preparation, cached

    def _prepare(self, counts: tuple[int, ...], max_items: int = 4 * MAX_PARTS) -> Prepared | None:
        made = self._prepared.get(counts)
        if made is None:
            plan = outline(self._tree, counts, max_items)
            if plan is None:
                return None
            made = Prepared(plan, self._model, counts)
            if made.codable:
                _remember(self._prepared, counts, made)
        return made

    def _layout(self, shape: Shape, header: bytes) -> Layout | None:
        key = (shape.counts, shape.texts, header, shape.tail)
        found = self._layouts.get(key)
        if found is None:
            prepared = self._prepare(shape.counts)
            if prepared is None:
                return None
            found = _remember(self._layouts, key, Layout(prepared.plan, shape, header))
        return found

    # Encoding

    def _static_values(self, prepared: Prepared, layout: Layout, values: Sequence[Any]) -> tuple[Value, ...]:
        picked = [values[index] for index in prepared.static_indexes]
        if layout.shape.order == BIG:
            for n, slot in enumerate(prepared.plan.static_values):
                if slot.kind == MATRIX:
                    picked[n] = bulk.swapped(picked[n], 8)
        if layout.long_texts:
            for n, index in enumerate(prepared.static_indexes):
                if index in layout.long_texts:
                    picked[n] = layout.long_texts[index]
        return tuple(picked)

    def _push_static(self, prepared: Prepared, layout: Layout, values: Sequence[Any]) -> int:
        key = self._static_values(prepared, layout, values)
        known = (prepared.counts, key)
        x = self._coded.get(known)
        if x is None:
            number = prepared.templates.get(key, PARTS)
            x = 0
            if number == PARTS:
                x = push_static(key, prepared.plan.static_values, self._model.words, self._model.constants)
            if self._model.templates:
                x = TEMPLATES.push(x, number)
            _remember(self._coded, known, x)
        return x

    def _push_live(
        self,
        x: int,
        prepared: Prepared,
        values: Sequence[Any],
        reals: Sequence[float],
        ways: list[tuple[int, int]],
    ) -> int:
        constants = self._model.constants
        for slot, table in prepared.backward:
            kind, index = slot.kind, slot.index
            if kind == DOUBLE:
                x = push_double(x, values[index], reals[slot.real], table, constants)
            elif kind == QUATERNION:
                x = push_quaternion(x, values[index : index + 4], reals[slot.real : slot.real + 4], table, constants)
            elif kind == TIME:
                x = push_stamp(x, values[index], values[index + 1])
            elif kind == SINGLE:
                x = push_single(x, values[index], reals[slot.real], table)
            elif kind == INTEGER:
                value = values[index]
                x = push_natural(x, (value << 1 if value >= 0 else ~(value << 1)) if slot.size < 0 else value)
            elif kind == OCTETS:
                x = x << 8 * slot.size | int.from_bytes(values[index], "big")
            else:
                way, parameter = ways.pop()
                x = push_natural(push_natural(x, parameter), way)
        return x

    def _blob(
        self, layout: Layout, prepared: Prepared, values: Sequence[Any]
    ) -> tuple[bytes, list[tuple[int, int]], int]:
        """(second part, transform of each array, whether it is compressed)"""
        ways, parts = [], []
        for slot in prepared.bulk:
            data = values[slot.index]
            if layout.shape.order == BIG:
                data = bulk.swapped(data, slot.size)
            way, parameter, turned = bulk.transform(data, slot.size, slot.real >= 0, self._measure)
            ways.append((way, parameter))
            parts.append(turned)
        parts += [values[index] for index in layout.long_texts]
        raw = b"".join(parts)
        packed = self._zstd.compress(raw, sized=False)
        return (packed, ways, _ZSTD) if len(packed) < len(raw) else (raw, ways, _RAW)

    def _measure(self, data: bytes) -> int:
        return len(self._zstd.compress(data, sized=False))

    # Decoding

    def _decode(self, coded: bytes, with_blob: bool, max_size: int) -> bytes:
        if self._fixed is None:
            raise DamagedError("damaged message: too many parts")
        max_items = min(MAX_CODED_ITEMS, self._fixed + bounds.most_items(len(coded)))
        blob = b""
        if with_blob:
            length, start = read_varint(coded)
            if length > len(coded) - start:
                raise DamagedError("damaged message: its number is cut off")
            coded, blob = coded[start : start + length], coded[start + length :]
        if len(coded) > MAX_NUMBER:
            raise DamagedError(f"damaged message: a number of {len(coded)} bytes")
        x, head = _HEADS.pop(from_bytes(coded))
        header, tail = _HEADERS[head >> 2], head & 3
        packed = _RAW
        if with_blob:
            x, packed = _BLOB.pop(x)
        counts: tuple[int, ...] = ()
        if self._open:
            taken: list[int] = []
            x = self._pop_counts(x, self._tree, taken, max_items)
            counts = tuple(taken)
        prepared = self._prepare(counts, max_items)
        if prepared is None or not prepared.codable or len(prepared.plan.items) > max_items:
            raise DamagedError("damaged message: too many parts")
        values = prepared.blank.copy()
        values[0], values[-1] = header, bytes(tail)
        x, ways = self._pop_live(x, prepared, values)
        static_values = self._pop_static(x, prepared)
        big = header[1] == 0
        texts: list[int] = []
        arrays = [
            _Array(slot.index, prepared.plan.items[slot.index][2], slot.size, way, parameter)
            for slot, (way, parameter) in zip(prepared.bulk, ways, strict=True)
        ]
        for slot, value in zip(prepared.plan.static_values, static_values, strict=True):
            index = slot.index
            if slot.kind == STRING:
                length = value if isinstance(value, int) else len(value)
                values[index - 1] = length
                texts.append(length)
                if isinstance(value, int):
                    arrays.append(_Array(index, length, 1, bulk.PLAIN, 0))
            values[index] = (
                bulk.swapped(value, 8) if big and slot.kind == MATRIX and isinstance(value, bytes) else value
            )
        self._take_blob(blob, packed, arrays, values, max_size)
        layout = self._layout(Shape(BIG if big else LITTLE, counts, tuple(texts), tail), header)
        if layout is None or layout.size > max_size:
            raise DamagedError(f"damaged message: larger than {max_size} bytes")
        return layout.pack(*values)

    def _pop_counts(self, x: int, node: Node, taken: list[int], most: int) -> int:
        if isinstance(node, Composite):
            for _, member in node.members:
                x = self._pop_counts(x, member, taken, most)
        elif isinstance(node, Repeat):
            count = node.count
            if count is None:
                x, count = pop_natural(x)
                taken.append(count)
            if is_open(node.element):
                for _ in range(count):
                    if len(taken) > most:
                        raise DamagedError("damaged message: too many sequences")
                    x = self._pop_counts(x, node.element, taken, most)
        return x

    def _pop_live(self, x: int, prepared: Prepared, values: list[Any]) -> tuple[int, list[tuple[int, int]]]:
        constants = self._model.constants
        ways = []
        for slot, table in prepared.forward:
            kind, index = slot.kind, slot.index
            if kind == DOUBLE:
                x, values[index] = pop_double(x, table, constants)
            elif kind == QUATERNION:
                x, values[index : index + 4] = pop_quaternion(x, table, constants)
            elif kind == TIME:
                x, values[index], values[index + 1] = pop_stamp(x)
            elif kind == SINGLE:
                x, values[index] = pop_single(x, table)
            elif kind == INTEGER:
                x, value = pop_natural(x)
                if slot.size < 0:
                    value = ~(value >> 1) if value & 1 else value >> 1
                values[index] = value
            elif kind == OCTETS:
                values[index] = (x & ((1 << 8 * slot.size) - 1)).to_bytes(slot.size, "big")
                x >>= 8 * slot.size
            else:
                x, way = pop_natural(x)
                x, parameter = pop_natural(x)
                ways.append((way, parameter))
        return x, ways

    def _pop_static(self, x: int, prepared: Prepared) -> Sequence[Value]:
        known = (prepared.counts, x)
        values = self._values.get(known)
        if values is not None:
            return values
        rest, number = TEMPLATES.pop(x) if self._model.templates else (x, PARTS)
        if number != PARTS:
            if number not in prepared.template_values:
                raise DamagedError("damaged message: a template of another shape")
            found = prepared.template_values[number]
        else:
            rest, found = pop_static(rest, prepared.plan.static_values, self._model.words, self._model.constants)
        if rest:
            raise DamagedError("damaged message: more values than its type has")
        return _remember(self._values, known, tuple(found))

    def _take_blob(self, blob: bytes, packed: int, arrays: Sequence[_Array], values: list[Any], max_size: int) -> None:
        """Store the arrays and long strings of the second part in their items."""
        size = sum(array.length for array in arrays)
        if size > max_size:
            raise DamagedError(f"damaged message: larger than {max_size} bytes")
        raw = self._zstd.decompress(blob, max_size, size) if packed == _ZSTD else blob
        if len(raw) != size:
            raise DamagedError(f"damaged message: {len(raw)} bytes of arrays instead of {size}")
        big = values[0][1] == 0
        at = 0
        for array in arrays:
            data = bulk.inverse_transform(array.way, array.parameter, raw[at : at + array.length], array.size)
            values[array.item] = bulk.swapped(data, array.size) if big else data
            at += array.length


def _remember(memory: dict[_K, _V], key: _K, value: _V) -> _V:
    """Cache a value that can always be computed again; drop the oldest entry when the cache is full."""
    if len(memory) >= _REMEMBERED:
        del memory[next(iter(memory))]
    memory[key] = value
    return value
