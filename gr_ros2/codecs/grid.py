"""The codec of occupancy grids: what has changed since a grid that all receivers have confirmed, or the whole grid.

A grid that has grown or moved is compared with the confirmed one where both overlap, cells that are new with the
unknown (-1). What is sent is the box around all changes, as differences (XOR) or as it is, whichever is shorter.

Invariants: exact to the byte; a whole grid is sent when nothing is confirmed or a key frame is asked for; a decoder
keeps at most ``KEPT`` grids beside the one that was last referred to, and an encoder refers to no other.
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from struct import pack
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gr_ros2.codecs.base import MAX_SIZE, Coded, frame, keep, name_of, opened
from gr_ros2.codecs.messages import GRID, GRID_UPDATE, read, take
from gr_ros2.codecs.pack import Packer
from gr_ros2.compression import bounds
from gr_ros2.compression.zstd_frames import read_varint
from gr_ros2.core.errors import DamagedError, MissingFrameError
from gr_ros2.wire import varint

_UNKNOWN = 0xFF
_WHOLE, _CHANGES = range(2)
_PLAIN, _XOR = range(2)
Cells = npt.NDArray[np.uint8]


class _Grid(NamedTuple):
    """A message in parts.

    :param head: bytes before the cells
    :param cells: shape (height, width)
    :param tail: bytes behind them
    :param place: of cell (0, 0), in cells; None where the message has no finite place
    """

    head: bytes
    cells: Cells
    tail: bytes
    place: tuple[int, int] | None

    @property
    def message(self) -> bytes:
        return self.head + self.cells.tobytes() + self.tail


@dataclass(frozen=True)
class GridCodec:
    """Maps as what has changed. It has no options."""

    type_name: str

    def encoder(self) -> GridEncoder:
        return GridEncoder()

    def decoder(self, max_size: int = MAX_SIZE) -> GridDecoder:
        return GridDecoder(max_size)

    @property
    def output(self) -> str:
        return GRID


class GridEncoder:
    """Maps to frames."""

    def __init__(self) -> None:
        self._packer = Packer()
        self._sent: OrderedDict[int, _Grid] = OrderedDict()
        self._base: int | None = None
        """The newest grid that was confirmed, by name."""

    def encode(self, message: bytes, budget: int | None = None, key: bool = False) -> Coded:  # noqa: ARG002
        grid = _split(message)
        coded = frame(_WHOLE, self._packer.pack(message))
        if key:
            self._sent.clear()
            self._base = None
        elif self._base is not None and self._base in self._sent:  # others hold the newest ``KEPT`` that they got
            changes = self._changes(self._base, self._sent[self._base], grid)
            coded = changes if len(changes.data) < len(coded.data) else coded
        keep(self._sent, coded.name, grid)
        return coded

    def confirmed(self, name: int) -> None:
        if name in self._sent:
            self._base = name
            while next(iter(self._sent)) != name:
                self._sent.popitem(last=False)

    def _changes(self, name: int, base: _Grid, grid: _Grid) -> Coded:
        height, width = grid.cells.shape
        dx, dy = (base.place[0] - grid.place[0], base.place[1] - grid.place[1]) if base.place and grid.place else (0, 0)
        if max(abs(dx), abs(dy)) >= 1 << 31:
            dx = dy = 0
        expected = _moved(base.cells, width, height, dx, dy)
        changed = expected != grid.cells
        rows, columns = np.flatnonzero(changed.any(1)), np.flatnonzero(changed.any(0))
        top, bottom = (int(rows[0]), int(rows[-1]) + 1) if len(rows) else (0, 0)
        left, right = (int(columns[0]), int(columns[-1]) + 1) if len(rows) else (0, 0)
        box = grid.cells[top:bottom, left:right]
        head = _xor(grid.head, base.head)
        forms = {_PLAIN: box, _XOR: box ^ expected[top:bottom, left:right]}
        packed = {way: self._packer.pack(head + grid.tail + cells.tobytes()) for way, cells in forms.items()}
        way = min(packed, key=lambda way: len(packed[way]))
        shape = (width, height, _folded(dx), _folded(dy), way, left, top, right - left, len(head), len(grid.tail))
        return frame(_CHANGES, b"".join(map(varint, shape)) + packed[way], name)


class GridDecoder:
    """Frames back to messages."""

    def __init__(self, max_size: int) -> None:
        self._packer, self._max_size = Packer(), max_size
        self._held: OrderedDict[int, _Grid] = OrderedDict()

    @property
    def held(self) -> int:
        """Bytes in use."""
        return sum(grid.cells.size for grid in self._held.values())

    def decode(self, data: bytes) -> bytes:
        form, before, body = opened(data)
        if form > _CHANGES or (form == _CHANGES) != (before is not None):
            raise DamagedError(f"damaged grid: no form {form}")
        if before is None:
            message = self._packer.unpack(body, self._max_size)
            grid = _split(message)
        else:
            base = self._held.get(before)
            if base is None:
                raise MissingFrameError("grid: the grid that this one changes was not decoded here")
            grid = self._changed(body, base)
            message = grid.message
            grid = _split(message)  # which also checks that it is one
        keep(self._held, name_of(data), grid)
        return message

    def _changed(self, body: bytes, base: _Grid) -> _Grid:
        shape, rest = [], body
        for _ in range(10):
            value, at = read_varint(rest)
            shape.append(value)
            rest = rest[at:]
        width, height, dx, dy, way, left, top, across, head_size, tail_size = shape
        most = min(self._max_size, base.cells.size + bounds.largest(len(body)))
        if width * height > most or max(width, height) > most:
            raise DamagedError(f"damaged grid: {width} × {height} cells, at most {most} are accepted")
        content = self._packer.unpack(rest, self._max_size)
        parts, box = take(content, head_size + tail_size)
        down = len(box) // across if across else 0
        if way > _XOR or across * down != len(box) or left + across > width or top + down > height:
            raise DamagedError("damaged grid: a box that does not fit")
        cells = _moved(base.cells, width, height, _unfolded(dx), _unfolded(dy))
        part = cells[top : top + down, left : left + across]
        new = np.frombuffer(box, np.uint8).reshape(down, across)
        part[...] = part ^ new if way == _XOR else new
        return _Grid(_xor(parts[:head_size], base.head), cells, parts[head_size:], None)


def updated(message: bytes, update: bytes) -> bytes:
    """The map of ``message`` with the box of an OccupancyGridUpdate in it, and with the time of that.

    :raises DamagedError: not such messages, or a box that does not fit
    """
    box, grid = read(GRID_UPDATE, update), _split(message)
    if box.width * box.height != len(box.data):
        raise DamagedError(f"damaged update: {box.width} × {box.height} cells, but {len(box.data)} are there")
    height, width = grid.cells.shape
    right, bottom = box.x + box.width, box.y + box.height
    if min(box.x, box.y) < 0 or right > width or bottom > height:
        raise DamagedError(
            f"damaged update: {box.width} × {box.height} cells at {box.x}, {box.y} of a map of {width} × {height}"
        )
    cells = grid.cells.copy()
    cells[box.y : bottom, box.x : right] = box.data.view(np.uint8).reshape(box.height, box.width)
    order = "<" if message[1] else ">"
    stamp = pack(f"{order}iI", box.header.stamp.sec, box.header.stamp.nanosec)
    return message[:4] + stamp + grid.head[4 + len(stamp) :] + cells.tobytes() + grid.tail


def _split(message: bytes) -> _Grid:
    """:raises DamagedError: not a grid, or one whose size does not fit its cells"""
    grid = read(GRID, message)
    info: Any = grid.info
    if info.width * info.height != len(grid.data):
        raise DamagedError(f"damaged grid: {info.width} × {info.height} cells, but {len(grid.data)} are there")
    # Without cells, its other side may say any number, and costs memory.
    shape = (info.height, info.width) if len(grid.data) else (0, 0)
    cells = np.frombuffer(grid.data, np.uint8).reshape(shape)
    # The cells are the last member: behind them stand at most three bytes of padding.
    begin = _begin(message, len(grid.data))
    end = begin + len(grid.data)
    return _Grid(message[:begin], cells, message[end:], _place(info))


def _begin(message: bytes, count: int) -> int:
    order: Any = "little" if message[1] else "big"
    for tail in range(4):
        begin = len(message) - tail - count
        if begin % 4 == 0 and int.from_bytes(message[begin - 4 : begin], order) == count:
            return begin
    raise DamagedError("damaged grid: bytes behind its cells")


def _place(info: Any) -> tuple[int, int] | None:
    """Where the first cell is, in cells from the origin of the frame. It only helps to find what is the same."""
    corner = np.array([info.origin.position.x, info.origin.position.y])
    with np.errstate(all="ignore"):
        found = corner / np.float64(info.resolution)
    return (round(found[0]), round(found[1])) if np.isfinite(found).all() and (abs(found) < 1 << 30).all() else None


def _moved(cells: Cells, width: int, height: int, dx: int, dy: int) -> Cells:
    """The cells at another place in a grid of another size; the others are unknown."""
    made = np.full((height, width), _UNKNOWN, np.uint8)
    old_height, old_width = cells.shape
    left, right = max(0, dx), min(width, dx + old_width)
    top, bottom = max(0, dy), min(height, dy + old_height)
    if left < right and top < bottom:
        made[top:bottom, left:right] = cells[top - dy : bottom - dy, left - dx : right - dx]
    return made


def _xor(head: bytes, other: bytes) -> bytes:
    """Each byte with that of the other; where the other is shorter, as it is."""
    size = min(len(head), len(other))
    both = int.from_bytes(head[:size], "little") ^ int.from_bytes(other[:size], "little")
    return both.to_bytes(size, "little") + head[size:]


def _folded(value: int) -> int:
    """A number of either sign as one that is not negative, small where it is small."""
    return 2 * value if value >= 0 else -2 * value - 1


def _unfolded(value: int) -> int:
    return value // 2 if value % 2 == 0 else -(value + 1) // 2
