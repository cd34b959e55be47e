"""The codec of point clouds: exact, or as voxels.

Exact: each field of all points is coded by itself (``compression.bulk``), then all by zstd. As voxels: which cells of a
grid hold a point, as an octree; a cell comes out as one point at its centre, with the mean intensity or colour of its
points where that is asked for.

Invariants: exact is exact to the byte; a point of a voxel lies within half a voxel, for each axis, of a point that
comes out, beside the rounding of float32; points that are not finite or beyond the range are left out, and the frame
says what is; each frame stands alone.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from struct import Struct
from typing import Any, Literal, NamedTuple

import numpy as np

from gr_ros2.codecs import octree
from gr_ros2.codecs.base import MAX_SIZE, Coded, frame, opened
from gr_ros2.codecs.messages import CLOUD, Origin, header_of, read, stamp_of, store, take, take_text, text, write
from gr_ros2.codecs.octree import Whole
from gr_ros2.codecs.pack import Packer
from gr_ros2.compression import bulk
from gr_ros2.compression.zstd_frames import read_varint
from gr_ros2.core.errors import CodecError, ConfigError, DamagedError, UnfitError
from gr_ros2.wire import varint

KEEP = ("", "intensity", "rgb")
_EXACT, _VOXELS = range(2)
_KINDS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""numpy's names of the types of a PointField."""
_FLOAT32, _FLOAT64, _UINT32 = 7, 8, 6
_META = Struct("<f3iBBBff")
"""Edge of a voxel (m), the lowest cell, how often the edge was doubled since, levels of the octree, what is kept, and
its least and greatest value."""
_MOST_CELLS = (1 << 31) - 1
STEPS = 4
"""Sizes of voxels from one to twice as large: a fourth of the budget is left over at most, of factors of two alone a
half in the mean."""
_STEEP, _TRIES = 1.7, 4
"""Bytes of a cloud fall with this power of the edge, by a scanner's recordings; so many edges are tried for a cloud."""
_FAST = 1
"""Level of zstd with which transforms are compared."""


@dataclass(frozen=True)
class CloudCodec:
    """Clouds as an octree of voxels, or exactly.

    :param voxel: edge of a voxel, m; 0 = exact
    :param range: m from the origin of the cloud's frame; points beyond are left out, of voxels only
    :param keep: what of a voxel is sent beside its place: '', 'intensity' or 'rgb'
    """

    type_name: str
    voxel: float = 0.0
    range: float = math.inf
    keep: Literal["", "intensity", "rgb"] = ""

    def __post_init__(self) -> None:
        if not (0 <= self.voxel < math.inf):
            raise ConfigError(f"cloud: voxel is {self.voxel}; give the edge of a voxel in m, or 0 for exact clouds")
        if not self.range > 0:
            raise ConfigError(f"cloud: range is {self.range}; give a distance in m above 0")
        if self.keep not in KEEP:
            raise ConfigError(f"cloud: keep is {self.keep!r}; it takes intensity, rgb, or '' for neither")

    def encoder(self) -> CloudEncoder:
        return CloudEncoder(self)

    def decoder(self, max_size: int = MAX_SIZE) -> CloudDecoder:
        return CloudDecoder(max_size)

    @property
    def output(self) -> str:
        return CLOUD


class _Voxels(NamedTuple):
    """Voxels in tree order.

    :param lowest: the corner of all, in edges
    :param doubled: how often the edge was doubled since
    :param codes: Morton numbers of the cells above ``lowest``
    :param values: kept values of each, 0..255, shape (n, channels)
    """

    edge: float
    lowest: Whole
    doubled: int
    codes: Whole
    values: Whole
    least: float
    greatest: float


class _Tree(NamedTuple):
    """:param step: by which its voxels are larger than asked for"""

    step: int
    voxels: _Voxels
    depth: int
    body: bytes


class CloudEncoder:
    """Clouds to frames."""

    def __init__(self, options: CloudCodec) -> None:
        self._options = options
        self._packer, self._fast = Packer(), Packer(_FAST)
        self._step = 0
        """By how many steps the voxels of the newest cloud were larger than asked for."""

    def encode(self, message: bytes, budget: int | None = None, key: bool = False) -> Coded:  # noqa: ARG002
        """The frame of a cloud. Voxels become larger until the frame is within the budget, in steps of ``STEPS`` for
        each factor of two, from those of the cloud before: steps that are small waste little of it."""
        cloud = read(CLOUD, message)
        _check(cloud)
        if not self._options.voxel:
            return self._exact(message, cloud)
        points, inside = _points(cloud, self._options.range)
        kept, without = self._kept(cloud, inside)
        count, out = points.shape[1], len(inside) - points.shape[1]
        left_out = f"without {out} of {len(inside)} points, which are not finite or beyond {self._options.range:g} m"
        parts = [left_out] * bool(out) + without
        said = "; ".join([f"voxels of {self._options.voxel:g} m", *parts])
        if not count:
            nothing = _Voxels(self._options.voxel, np.zeros(3), 0, np.zeros(0, np.uint64), *_NO_VALUES)
            return frame(_VOXELS, self._body(cloud, nothing, 0), said=said)
        tree = self._tree(cloud, points, kept, 0 if budget is None else self._step)
        if budget is not None:
            tree = self._within(budget - 1, tree, lambda step: self._tree(cloud, points, kept, step))
            self._step = tree.step
        voxels, depth, body = tree.voxels, tree.depth, tree.body
        while budget is not None and len(body) + 1 > budget and depth:
            voxels, depth = _coarser(voxels), depth - 1
            body = self._body(cloud, voxels, depth)
        edge = voxels.edge * 2**voxels.doubled
        if tree.step or voxels.doubled:
            said = "; ".join([f"voxels of {edge:.3g} m instead of {self._options.voxel:g} m", *parts])
        return frame(_VOXELS, body, said=said)

    def _tree(self, cloud: Any, points: Whole, kept: Whole | None, step: int) -> _Tree:
        """A cloud whose voxels are so many steps larger than asked for."""
        voxels = self._voxels(points, kept, self._options.voxel * 2 ** (step / STEPS))
        depth = int(octree.cells(voxels.codes).max()).bit_length()
        return _Tree(step, voxels, depth, self._body(cloud, voxels, depth))

    def _within(self, most: int, tree: _Tree, made: Callable[[int], _Tree]) -> _Tree:
        """The finest of a few trees that is within a budget, or the coarsest."""
        tried = {tree.step: tree}
        while len(tried) < _TRIES:
            size = max(len(tree.body), 1)
            far = STEPS * math.log2(size / max(most, 1)) / _STEEP
            step = max(0, tree.step + (math.ceil(far) if far > 0 else -math.floor(-far)))
            if step in tried or not tree.voxels.codes.size:
                break
            tree = tried[step] = made(step)
        fitting = [step for step, tree in tried.items() if len(tree.body) <= most]
        return tried[min(fitting) if fitting else max(tried)]

    def confirmed(self, name: int) -> None:
        """Do nothing: no frame needs a confirmed one."""

    def _voxels(self, points: Whole, kept: Whole | None, edge: float) -> _Voxels:
        edge = float(np.float32(edge))  # as it leaves
        places = np.floor(points / edge)
        lowest = places.min(1)
        if np.abs(places).max() > _MOST_CELLS or (places.max(1) - lowest).max() >= 1 << octree.MAX_LEVELS:
            raise UnfitError(
                f"cloud: more than {1 << octree.MAX_LEVELS} voxels of {edge:g} m side by side; "
                "give a range, or larger voxels"
            )
        codes = octree.numbers((places - lowest[:, None]).astype(np.uint64))
        if kept is None:
            return _Voxels(edge, lowest, 0, np.unique(codes), *_NO_VALUES)
        codes, which, count = np.unique(codes, return_inverse=True, return_counts=True)
        means = np.stack([np.bincount(which, channel) / count for channel in kept.T], 1)
        least, greatest = (0.0, 255.0) if self._options.keep == "rgb" else (float(means.min()), float(means.max()))
        scaled = (means - least) * (255 / (greatest - least) if greatest > least else 0)
        return _Voxels(edge, lowest, 0, codes, np.rint(scaled).astype(np.uint8), least, greatest)

    def _kept(self, cloud: Any, inside: Whole) -> tuple[Whole | None, list[str]]:
        """The values that are kept, shape (points, channels), and what is left out of each point."""
        fields = {field.name: field for field in cloud.fields}
        keep = self._options.keep if self._options.keep in fields else "rgba" if "rgba" in fields else ""
        if not self._options.keep or (keep == "rgba" and self._options.keep != "rgb"):
            keep = ""
        others = [name for name in fields if name not in ("x", "y", "z", keep)]
        said = [f"without {', '.join(others)}"] if others else []
        if not keep:
            return None, said
        if keep == "intensity":
            with np.errstate(invalid="ignore"):
                values = _column(cloud, fields[keep]).ravel()[inside].astype(np.float64)
            return np.nan_to_num(values, posinf=0, neginf=0)[:, None], said
        field = fields[keep]
        if field.datatype not in (_FLOAT32, _UINT32, 5):
            raise UnfitError(f"cloud: field {keep} is not packed in 32 bits")
        packed = _column(cloud, field, _UINT32).ravel()[inside]
        return np.stack([packed >> shift & 255 for shift in (16, 8, 0)], 1).astype(np.float64), said

    def _body(self, cloud: Any, voxels: _Voxels, depth: int) -> bytes:
        origin = Origin(cloud.header)
        keep = KEEP.index(self._options.keep) if voxels.values.size else 0
        meta = _META.pack(
            voxels.edge, *map(int, voxels.lowest), voxels.doubled, depth, keep, voxels.least, voxels.greatest
        )
        tree = b"".join(octree.levels(voxels.codes, depth)) if len(voxels.codes) else b""
        values = np.diff(voxels.values, axis=0, prepend=np.uint8(0)).T.tobytes()
        count = varint(len(voxels.codes))
        return origin.stamp() + text(origin.frame_id) + meta + count + self._packer.pack(tree + values)

    def _exact(self, message: bytes, cloud: Any) -> Coded:
        begin, end = _data(message, cloud)
        data = message[begin:end]
        points = len(data) // cloud.point_step if cloud.point_step else 0
        columns = _columns(cloud) if data and points * cloud.point_step == len(data) else []
        layout, parts = [bytes([len(columns)])], []
        rows = np.frombuffer(data, np.uint8).reshape(points, -1) if columns else None
        at = 0
        for size, real in columns:
            assert rows is not None
            values = rows[:, at : at + size].tobytes()
            at += size
            if cloud.is_bigendian:
                values = bulk.swapped(values, size)
            way, parameter, turned = bulk.transform(values, size, real, lambda data: len(self._fast.pack(data)))
            layout.append(bytes([size, way, parameter]))
            parts.append(turned)
        packed = self._packer.pack(b"".join([message[:begin], message[end:], *(parts or [data])]))
        sizes = varint(begin) + varint(len(message) - end)
        return frame(_EXACT, sizes + bytes([bool(cloud.is_bigendian)]) + b"".join(layout) + packed)


_NO_VALUES: tuple[Any, ...] = (np.zeros((0, 0), np.uint8), 0.0, 0.0)


class CloudDecoder:
    """Frames back to messages."""

    def __init__(self, max_size: int) -> None:
        self._packer, self._max_size = Packer(), max_size

    def decode(self, data: bytes) -> bytes:
        form, before, body = opened(data)
        if before is not None or form > _VOXELS:
            raise DamagedError(f"damaged cloud: no form {form}")
        try:
            message = self._exact(body) if form == _EXACT else self._voxels(body)
        except (ValueError, OverflowError) as error:
            if isinstance(error, CodecError):
                raise
            raise DamagedError(f"damaged cloud: {error}") from error
        if len(message) > self._max_size:
            raise DamagedError(f"damaged cloud: larger than {self._max_size} bytes")
        return message

    def _exact(self, body: bytes) -> bytes:
        begin, at = read_varint(body)
        tail, more = read_varint(body[at:])
        head, rest = take(body[at + more :], 2)
        big, columns = head[0], head[1]
        layout, rest = take(rest, 3 * columns)
        whole = self._packer.unpack(rest, self._max_size)
        outer, data = take(whole, begin + tail)
        if columns:
            step = sum(layout[::3])
            if not step or len(data) % step:
                raise DamagedError("damaged cloud: points that are not whole")
            points, at, used = len(data) // step, 0, 0
            rows = np.empty((points, step), np.uint8)
            for size, way, parameter in zip(layout[::3], layout[1::3], layout[2::3], strict=True):
                if size not in (1, 2, 4, 8):
                    raise DamagedError(f"damaged cloud: a field of {size} bytes")
                values = bulk.inverse_transform(way, parameter, data[used : used + size * points], size)
                if big:
                    values = bulk.swapped(values, size)
                rows[:, at : at + size] = np.frombuffer(values, np.uint8).reshape(points, size)
                at, used = at + size, used + size * points
            data = rows.tobytes()
        return outer[:begin] + data + outer[begin:]

    def _voxels(self, body: bytes) -> bytes:
        stamp, (frame_id, rest) = stamp_of(body), take_text(body[8:])
        meta, rest = take(rest, _META.size)
        edge, *lowest, doubled, depth, keep, least, greatest = _META.unpack(meta)
        count, at = read_varint(rest)
        step = 12 if not keep else 16
        if (
            depth + doubled > octree.MAX_LEVELS
            or keep >= len(KEEP)
            or not 0 < edge < math.inf
            or count * step > self._max_size
        ):
            raise DamagedError("damaged cloud: voxels that cannot be")
        content = self._packer.unpack(rest[at:], self._max_size)
        channels = (0, 1, 3)[keep]
        if count * channels > len(content):
            raise DamagedError("damaged cloud: values are missing")
        tree, packed = content[: len(content) - count * channels], content[len(content) - count * channels :]
        codes = octree.leaves(tree, depth, count) if count else np.zeros(0, np.uint64)
        if len(codes) != count or (not count and tree):
            raise DamagedError(f"damaged cloud: {len(codes)} voxels instead of {count}")
        points = np.empty((count, step // 4), "<f4")
        places = (octree.cells(codes) + 0.5) * 2**doubled + np.array(lowest)[:, None]
        with np.errstate(over="ignore"):
            points[:, :3] = (places * np.float64(edge)).T
        if not np.isfinite(points[:, :3]).all():
            raise DamagedError("damaged cloud: points beyond all numbers")
        if channels:
            values = np.cumsum(np.frombuffer(packed, np.uint8).reshape(channels, count), axis=1, dtype=np.uint8)
            if keep == 1:
                with np.errstate(all="ignore"):  # the ends may be any numbers
                    points[:, 3] = least + values[0] * ((greatest - least) / 255)
            else:
                red, green, blue = values.astype("<u4")
                points[:, 3] = (red << np.uint32(16) | green << np.uint32(8) | blue).view("<f4")
        return _written(header_of(stamp, frame_id), points, KEEP[keep])


def _written(header: Any, points: Whole, keep: str) -> bytes:
    field = store().types["sensor_msgs/msg/PointField"]
    names = ["x", "y", "z"] + [keep] * bool(keep)
    return write(
        CLOUD,
        header=header,
        height=1,
        width=len(points),
        fields=[field(name=name, offset=4 * n, datatype=_FLOAT32, count=1) for n, name in enumerate(names)],
        is_bigendian=False,
        point_step=4 * len(names),
        row_step=4 * len(names) * len(points),
        data=np.frombuffer(points.tobytes(), np.uint8),
        is_dense=True,
    )


def _check(cloud: Any) -> None:
    """:raises DamagedError: when the size of a cloud does not fit its bytes"""
    points = cloud.width * cloud.height
    if points and not (
        0 < cloud.point_step * cloud.width <= cloud.row_step and cloud.row_step * cloud.height <= len(cloud.data)
    ):
        raise DamagedError(
            f"damaged cloud: {cloud.width} × {cloud.height} points of {cloud.point_step} bytes, rows of "
            f"{cloud.row_step} bytes, do not fit its {len(cloud.data)} bytes"
        )


def _column(cloud: Any, field: Any, kind: int | None = None) -> Whole:
    """One field of all points, shape (height, width).

    :raises UnfitError: for a type or a place that a cloud cannot have
    """
    name = _KINDS.get(kind or field.datatype)
    if name is None or field.offset + int(name[1]) > cloud.point_step:
        raise UnfitError(f"cloud: field {field.name} has an unknown type or lies beyond its point")
    if not cloud.width * cloud.height:
        return np.zeros((0, 0), name)
    return np.ndarray(
        (cloud.height, cloud.width),
        (">" if cloud.is_bigendian else "<") + name,
        np.ascontiguousarray(cloud.data),
        field.offset,
        (cloud.row_step, cloud.point_step),
    )


def _points(cloud: Any, reach: float) -> tuple[Whole, Whole]:
    """Coordinates of the points that count, shape (3, n), float64; and which of all these are."""
    fields = {field.name: field for field in cloud.fields}
    if not {"x", "y", "z"} <= fields.keys() or any(fields[a].datatype not in (_FLOAT32, _FLOAT64) for a in "xyz"):
        raise UnfitError("cloud: no fields x, y and z of floating-point numbers")
    if not cloud.width * cloud.height:
        return np.zeros((3, 0)), np.zeros(0, bool)
    with np.errstate(invalid="ignore"):  # there are floats of which only computing with them tells that they are none
        points = np.stack([_column(cloud, fields[axis]).ravel() for axis in "xyz"]).astype(np.float64)
    x, y, z = points
    if reach < math.inf:
        with np.errstate(over="ignore", invalid="ignore"):
            inside = x * x + y * y + z * z <= reach * reach
    else:
        inside = np.isfinite(x) & np.isfinite(y) & np.isfinite(z)
    return np.compress(inside, points, axis=1), inside


def _coarser(voxels: _Voxels) -> _Voxels:
    codes, begins, count = np.unique(voxels.codes >> np.uint64(3), return_index=True, return_counts=True)
    values = voxels.values
    if values.size:
        values = np.rint(np.add.reduceat(values.astype(float), begins, axis=0) / count[:, None]).astype(np.uint8)
    return voxels._replace(doubled=voxels.doubled + 1, codes=codes, values=values)


def _columns(cloud: Any) -> list[tuple[int, bool]]:
    """Bytes of each column of a point, and whether it is of floats; what no field says is columns of one byte."""
    found: list[tuple[int, bool]] = []
    at = 0
    for field in sorted(cloud.fields, key=lambda field: int(field.offset)):
        name = _KINDS.get(field.datatype)
        if name is None or field.offset < at:
            continue
        count = min(field.count or 1, cloud.point_step)
        if field.offset + int(name[1]) * count > cloud.point_step:
            continue
        found += [(1, False)] * (field.offset - at) + [(int(name[1]), name[0] == "f")] * count
        at = field.offset + int(name[1]) * count
    found += [(1, False)] * (cloud.point_step - at)
    return found if len(found) < 256 else []


def _data(message: bytes, cloud: Any) -> tuple[int, int]:
    """Where the points stand in a message. If they should not, the frame is no less exact, only larger."""
    length = len(cloud.data)
    order: Any = "little" if message[1] else "big"
    for tail in range(4):
        begin = len(message) - 1 - tail - length
        if begin % 4 == 0 and begin >= 8 and int.from_bytes(message[begin - 4 : begin], order) == length:
            return begin, begin + length
    return len(message), len(message)
