"""The codec of occupancy grids: what has changed since a grid that all receivers have confirmed, or the whole grid.

A grid that has grown or moved is compared with the confirmed one where both overlap, cells that are new with the
unknown (-1). What is sent is the box around all changes, as differences (XOR) or as it is, whichever is shorter.
"""

from __future__ import annotations

from dataclasses import dataclass
from struct import pack
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gr_ros2.codecs.base import MAX_SIZE
from gr_ros2.codecs.changes import ChangesDecoder, ChangesEncoder
from gr_ros2.codecs.messages import GRID, GRID_UPDATE, read, take
from gr_ros2.codecs.pack import Packer
from gr_ros2.compression import bounds
from gr_ros2.compression.zstd_frames import read_varint
from gr_ros2.core.errors import DamagedError
from gr_ros2.wire import varint

_UNKNOWN = 0xFF
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


class GridEncoder(ChangesEncoder[_Grid]):
    """Maps to frames."""

    def __init__(self) -> None:
        super().__init__(Packer())

    def _read(self, message: bytes) -> _Grid:
        return _split(message)

    def _changes(self, base: _Grid, read: _Grid) -> bytes:
        height, width = read.cells.shape
        dx, dy = (base.place[0] - read.place[0], base.place[1] - read.place[1]) if base.place and read.place else (0, 0)
        if max(abs(dx), abs(dy)) >= 1 << 31:
            dx = dy = 0
        expected = _moved(base.cells, width, height, dx, dy)
        changed = expected != read.cells
        rows, columns = np.flatnonzero(changed.any(1)), np.flatnonzero(changed.any(0))
        top, bottom = (int(rows[0]), int(rows[-1]) + 1) if len(rows) else (0, 0)
        left, right = (int(columns[0]), int(columns[-1]) + 1) if len(rows) else (0, 0)
        box = read.cells[top:bottom, left:right]
        head = _xor(read.head, base.head)
        forms = {_PLAIN: box, _XOR: box ^ expected[top:bottom, left:right]}
        packed = {way: self._packer.pack(head + read.tail + cells.tobytes()) for way, cells in forms.items()}
        way = min(packed, key=lambda way: len(packed[way]))
        shape = (width, height, _folded(dx), _folded(dy), way, left, top, right - left, len(head), len(read.tail))
        return b"".join(map(varint, shape)) + packed[way]


class GridDecoder(ChangesDecoder[_Grid]):
    """Frames back to messages."""

    def _read(self, message: bytes) -> _Grid:
        return _split(message)

    def _size(self, read: _Grid) -> int:
        return read.cells.size

    def _changed(self, body: bytes, base: _Grid) -> bytes:
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
        return _xor(parts[:head_size], base.head) + cells.tobytes() + parts[head_size:]


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
    size = min(len(head), len(other))
    both = int.from_bytes(head[:size], "little") ^ int.from_bytes(other[:size], "little")
    return both.to_bytes(size, "little") + head[size:]


def _folded(value: int) -> int:
    """A number of either sign as one that is not negative, small where it is small."""
    return 2 * value if value >= 0 else -2 * value - 1


def _unfolded(value: int) -> int:
    return value // 2 if value % 2 == 0 else -(value + 1) // 2
