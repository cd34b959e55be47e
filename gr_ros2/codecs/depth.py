"""The codec of depth images, whose numbers are distances and never colours.

What is sent is the inverse of the distance, in equal steps between the nearest and the farthest: near things are finer
than far ones, as a sensor measures them. Within a budget it is the luma of H.264, of a size that the budget is enough
for (``sizes``), and a mask of blocks of 4 × 4 pixels or more says where there is depth; without one it has 8, 10 or 12
bits, differences of neighbours by zstd, and an exact mask.

Invariants: pixels without depth come out without depth (16UC1: 0, 32FC1: NaN), in video by blocks; with bits, 1/z of a
pixel is within half a step of 1/z of what went in, beside the rounding to the unit, unless it is nearer or farther than
the frame says; stamp and frame of the header stay.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from struct import Struct
from struct import error as StructError
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gr_ros2.codecs import video
from gr_ros2.codecs.base import MAX_SIZE, Coded, frame, opened
from gr_ros2.codecs.camera import rows_of
from gr_ros2.codecs.messages import (
    COMPRESSED_IMAGE,
    IMAGE,
    Origin,
    header_of,
    read,
    stamp_of,
    take,
    take_text,
    text,
    write,
)
from gr_ros2.codecs.pack import Packer
from gr_ros2.codecs.sizes import MAX_PIXELS, FittingSize
from gr_ros2.codecs.video import VideoDecoder, VideoEncoder
from gr_ros2.compression.zstd_frames import read_varint
from gr_ros2.core.errors import CodecError, ConfigError, DamagedError, OtherKindError, UnfitError
from gr_ros2.wire import varint

Values = npt.NDArray[Any]

UNITS = {"16UC1": 0.001, "mono16": 0.001, "32FC1": 1.0}
"""Metres of the unit of an encoding (REP 118)."""
_NUMBERS = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}
"""How each encoding writes a pixel, without its byte order."""
AUTO, EXACT = "auto", "exact"
MODES = (AUTO, "8", "10", "12", EXACT)
_USUAL_BITS = 10
NEAREST_M = 0.1
"""No sensor of depth measures nearer; a number that is smaller would spoil the steps of all others."""
_LEFT_OUT = 0.001
"""Part of the pixels that may lie outside the two distances of an automatic choice at either end."""
_FARTHEST_M = 1e30
"""m; the ends of a frame's distances are apart up to here, as float32 has them."""
_MARGIN = 1.15
"""A chain of frames keeps its distances until more than ``_OUTSIDE`` of the pixels lie outside them; room for some."""
_OUTSIDE = 0.005
_SAMPLE = 7
"""Every so many pixels are looked at to find the distances."""
_CELLS = (4, 8, 16, 32)
"""Pixels of the side of a block of the mask beside video: the least with which it takes no more than ..."""
_MASK_PART = 4
"""... this part of the budget. Of a sensor whose images have many holes it would be several budgets."""
_VIDEO, _BITS = 1, 2
_RANGE = Struct("<ff")
_CONFIG = Struct("<iff")
"""What stands before the picture in compressedDepth: its kind and the two numbers of its inverse distances."""


@dataclass(frozen=True)
class DepthCodec:
    """Depth as inverse distances within a budget.

    :param mode: 'auto' is video within a budget and 10 bits without one; 8, 10 or 12 bits; 'exact'
    :param near, far: m; 0 = found from the images
    """

    type_name: str
    mode: str = AUTO
    near: float = 0.0
    far: float = 0.0

    def __post_init__(self) -> None:
        if str(self.mode) not in MODES:
            raise ConfigError(f"depth: mode is {self.mode!r}; it takes {', '.join(MODES)}")
        if not (0 <= self.near < math.inf and 0 <= self.far < math.inf) or 0 < self.far <= self.near:
            raise ConfigError(f"depth: near is {self.near} and far {self.far}; give distances in m, or 0 for automatic")

    def encoder(self) -> DepthEncoder:
        return DepthEncoder(self)

    def decoder(self, max_size: int = MAX_SIZE) -> DepthDecoder:
        return DepthDecoder(self, max_size)

    @property
    def output(self) -> str:
        return self.type_name


class _Depth(NamedTuple):
    """:param metres: float32, shape (height, width); 0 = no depth
    :param label: encoding, or format of a compressed image with the two numbers of its inverse distances
    """

    origin: Origin
    metres: Values
    label: str


class DepthEncoder:
    """Depth to frames."""

    def __init__(self, options: DepthCodec) -> None:
        self._options = options
        self._video = VideoEncoder(_VIDEO)
        self._size = FittingSize()
        self._packer = Packer()
        self._range = (0.0, 0.0)

    def encode(self, message: bytes, budget: int | None = None, key: bool = False) -> Coded:
        mode = str(self._options.mode)
        image = _image_of(self._options.type_name, message)
        if mode == EXACT:
            raise UnfitError("")
        depth = _read(self._options.type_name, image)
        mask = depth.metres > 0
        near, far = self._distances(depth.metres, mask, key)
        said = f"inverse depth from {near:.2f} to {far:.2f} m"
        if mode == AUTO and budget is not None:
            metres = self._fitting(depth, budget, key)
            coded = self._as_video(depth._replace(metres=metres), near, far, budget, key)
            of, shown = (f"{each.shape[1]} × {each.shape[0]}" for each in (depth.metres, metres))
            return coded._replace(said=f"{said} as H.264 of {shown} pixels" + f", of {of}" * (of != shown))
        head = _head(depth, near, far)
        bits = _USUAL_BITS if mode == AUTO else int(mode)
        values = np.rint(_steps(depth.metres, mask, near, far, (1 << bits) - 1)).astype(np.int32)[mask]
        body = depth.origin.stamp() + head + bytes([bits]) + self._packer.pack(_differences(values, mask))
        return frame(_BITS, body, said=f"{said} in {bits} bits")

    def confirmed(self, name: int) -> None:
        """Do nothing: no frame needs a confirmed one."""

    def _fitting(self, depth: _Depth, budget: int, key: bool) -> Values:
        """The distances of every pixel, or of every second of both sides and so on. No mean is made of them: between a
        near and a far one there is nothing."""
        height, width = depth.metres.shape
        bytes_each = np.dtype(_NUMBERS[depth.label]).itemsize if self._options.type_name == IMAGE else 0
        each = 1 << self._size.halvings(width, height, bytes_each, budget, key)
        padded = np.pad(depth.metres, ((0, -height % each), (0, -width % each)), mode="edge")
        return padded[each // 2 :: each, each // 2 :: each]

    def _as_video(self, depth: _Depth, near: float, far: float, budget: int, key: bool) -> Coded:
        mask = depth.metres > 0
        luma = np.rint(_steps(depth.metres, mask, near, far, 255)).astype(np.uint8)
        for cell in _CELLS:
            packed = self._packer.pack(_cells(mask, cell))
            if _MASK_PART * len(packed) <= budget:
                break
        side = depth.origin.stamp() + bytes([cell]) + packed
        return self._video.encode(video.from_luma(_filled(luma, mask)), _head(depth, near, far), side, budget, key)

    def _distances(self, metres: Values, mask: Values, key: bool) -> tuple[float, float]:
        """The nearest and the farthest distance of the steps, m, as float32 has them."""
        sample = metres.ravel()[::_SAMPLE]
        sample = np.sort(sample[sample > 0])
        if not len(sample):
            sample = metres[mask] if mask.any() else np.ones(1, np.float32)
        low, high = (float(sample[int(part * (len(sample) - 1))]) for part in (_LEFT_OUT, 1 - _LEFT_OUT))
        near, far = self._range
        outside = np.searchsorted(sample, near) + len(sample) - np.searchsorted(sample, far, "right")
        if key or not near or outside > _OUTSIDE * len(sample):
            near = min(self._options.near or max(NEAREST_M, low / _MARGIN), _FARTHEST_M / 2)
            far = max(self._options.far or high * _MARGIN, near * 1.01)
            self._range = _RANGE.unpack(_RANGE.pack(near, min(far, _FARTHEST_M)))
        return self._range


class DepthDecoder:
    """Frames back to messages."""

    def __init__(self, options: DepthCodec, max_size: int) -> None:
        self._options, self._max_size = options, max_size
        self._most = min(MAX_PIXELS, max_size)
        self._video = VideoDecoder(self._most)
        self._packer = Packer()
        self.size: tuple[int, int] | None = None
        """Width and height of the newest picture that came as video."""

    def decode(self, data: bytes) -> bytes:
        form, before, body = opened(data)
        self.size = None
        try:
            if form == _VIDEO:
                return self._of_video(data)
            if form == _BITS and before is None:
                return self._of_bits(body)
        except (ValueError, OverflowError, StructError) as error:
            if isinstance(error, CodecError):
                raise
            raise DamagedError(f"damaged depth: {error}") from error
        raise DamagedError(f"damaged depth: no form {form}")

    def _of_video(self, data: bytes) -> bytes:
        head, side, _, picture, _ = self._video.read(data)
        width, height, label, frame_id, near, far, _ = self._head(head)
        if picture is None or (width + width % 2, height + height % 2) != self._video.size:
            raise DamagedError("damaged depth: its size is not that of the video")
        stamp, (cell,) = stamp_of(side), take(side[8:], 1)[0]
        if cell not in _CELLS:
            raise DamagedError(f"damaged depth: a mask of blocks of {cell} pixels")
        across, down = -(-width // cell), -(-height // cell)
        cells = np.frombuffer(self._packer.unpack(side[9:], self._max_size), np.uint8)
        if len(cells) != -(-across * down // 8):
            raise DamagedError("damaged depth: a mask of another size")
        known = np.unpackbits(cells)[: across * down].reshape(down, across).astype(bool)
        mask = known.repeat(cell, 0).repeat(cell, 1)[:height, :width]
        luma = video.to_rows(picture, width)[:height]
        metres = np.where(mask, _metres(np.arange(256), near, far, 255).astype(np.float32)[luma], 0)
        self.size = width, height
        return self._written(stamp, frame_id, label, metres)

    def _of_bits(self, body: bytes) -> bytes:
        stamp = stamp_of(body)
        width, height, label, frame_id, near, far, rest = self._head(body[8:])
        bits, packed = take(rest, 1)
        if bits[0] not in (8, 10, 12):
            raise DamagedError(f"damaged depth: {bits[0]} bits")
        mask, values = _from_differences(self._packer.unpack(packed, 8 * self._max_size), width, height)
        if len(values) and not 0 <= values.min() <= values.max() < 1 << bits[0]:
            raise DamagedError(f"damaged depth: not numbers of {bits[0]} bits")
        metres = np.zeros((height, width), np.float32)
        metres[mask] = _metres(values, near, far, (1 << bits[0]) - 1)
        return self._written(stamp, frame_id, label, metres)

    def _head(self, head: bytes) -> tuple[int, int, str, str, float, float, bytes]:
        width, at = read_varint(head)
        height, more = read_varint(head[at:])
        label, rest = take_text(head[at + more :])
        frame_id, rest = take_text(rest)
        distances, rest = take(rest, _RANGE.size)
        near, far = _RANGE.unpack(distances)
        if not 0 < near < far < math.inf or not 0 < width * height <= self._most:
            raise DamagedError(f"damaged depth: {width} × {height} pixels from {near} to {far} m")
        return width, height, label, frame_id, near, far, rest

    def _written(self, stamp: Any, frame_id: str, label: str, metres: Values) -> bytes:
        header = header_of(stamp, frame_id)
        if self._options.type_name == COMPRESSED_IMAGE:
            return self._compressed(header, label, metres)
        if label not in UNITS:
            raise DamagedError(f"damaged depth: encoding {label[:40]!r}")
        if label == "32FC1":
            data = np.where(metres > 0, metres, np.float32(np.nan)).astype("<f4")
        else:
            data = _whole(metres / UNITS[label])
        if data.nbytes > self._max_size:
            raise DamagedError(f"damaged depth: {data.nbytes} bytes, at most {self._max_size} are accepted")
        return write(
            IMAGE,
            header=header,
            height=len(data),
            width=data.shape[1],
            encoding=label,
            is_bigendian=0,
            step=data.strides[0],
            data=data.view(np.uint8).ravel(),
        )

    def _compressed(self, header: Any, label: str, metres: Values) -> bytes:
        format_, _, numbers = label.partition("|")
        a, b = (float.fromhex(number) for number in numbers.split())
        if format_.startswith("32FC1"):
            with np.errstate(divide="ignore", invalid="ignore"):
                data = _whole(np.where(metres > 0, a / metres + b, 0))
        else:
            data = _whole(metres / UNITS["16UC1"])
        rows = data.astype(">u2").view(np.uint8).reshape(len(data), -1)
        picture = video.packed("png", video.from_rows(rows, data.shape[1], "gray16be"))
        content = np.frombuffer(_CONFIG.pack(0, a, b) + picture, np.uint8)
        if len(content) > self._max_size:
            raise DamagedError(f"damaged depth: {len(content)} bytes, at most {self._max_size} are accepted")
        return write(COMPRESSED_IMAGE, header=header, format=format_, data=content)


def _image_of(type_name: str, message: bytes) -> Any:
    """The message as a value.

    :raises OtherKindError: for one that is not of depth
    """
    image = read(type_name, message)
    if type_name == IMAGE and image.encoding not in UNITS:
        raise OtherKindError(f"image: encoding {image.encoding!r} is neither of pictures nor of depth")
    if type_name == COMPRESSED_IMAGE and "compressedDepth" not in image.format:
        raise OtherKindError(f"image: format {image.format!r} is neither of pictures nor of depth")
    return image


def _head(depth: _Depth, near: float, far: float) -> bytes:
    height, width = depth.metres.shape
    size, origin = varint(width) + varint(height), text(depth.label) + text(depth.origin.frame_id)
    return size + origin + _RANGE.pack(near, far)


def _read(type_name: str, image: Any) -> _Depth:
    if type_name == COMPRESSED_IMAGE:
        return _read_compressed(image)
    kind = _NUMBERS[image.encoding]
    size = np.dtype(kind).itemsize
    rows = rows_of(image, size)[:, : image.width * size]
    values = np.ascontiguousarray(rows).view((">" if image.is_bigendian else "<") + kind)
    with np.errstate(all="ignore"):  # a float may be any number, also one that only computing with it tells of
        metres = values.astype(np.float32) * UNITS[image.encoding]
    return _Depth(Origin(image.header), _valid(metres), str(image.encoding))


def _read_compressed(image: Any) -> _Depth:
    data, label = bytes(image.data), str(image.format)
    kind = label[:5]
    if kind not in UNITS or data[_CONFIG.size : _CONFIG.size + 2] != b"\x89P":
        raise UnfitError(f"image: format {label!r} is not depth as PNG")
    _, a, b = _CONFIG.unpack_from(data)
    picture = video.still("png", data[_CONFIG.size :])
    if picture.format.name != "gray16be":
        raise UnfitError(f"image: depth in a PNG of {picture.format.name}")
    numbers = video.to_rows(picture, 2 * picture.width)
    raw = np.ascontiguousarray(numbers).view(">u2").astype(np.float32)
    if kind == "32FC1":
        with np.errstate(divide="ignore", invalid="ignore"):
            raw = np.where(raw > 0, a / (raw - b), 0)
    else:
        raw = raw * np.float32(UNITS[kind])
    return _Depth(Origin(image.header), _valid(raw), f"{label}|{a.hex()} {b.hex()}")


def _valid(metres: Values) -> Values:
    """The distances; 0 for what is none."""
    with np.errstate(invalid="ignore"):
        found: Values = np.where((metres > 0) & (metres < np.inf), metres, 0).astype(np.float32)
    return found


def _steps(metres: Values, mask: Values, near: float, far: float, top: int) -> Values:
    """Inverse distances from 0 (the farthest) to ``top`` (the nearest); 0 where there is none."""
    with np.errstate(over="ignore"):  # of what is nearer than any sensor measures
        inverse = 1 / np.where(mask, metres, np.float32(far))
        found: Values = np.clip((inverse - np.float32(1 / far)) * np.float32(top / (1 / near - 1 / far)), 0, top)
    return found


def _metres(steps: Values, near: float, far: float, top: int) -> Values:
    found: Values = 1 / (steps * ((1 / near - 1 / far) / top) + 1 / far)
    return found


def _whole(values: Values) -> Values:
    """As 16 bits without sign."""
    found: Values = np.clip(np.rint(values), 0, 65535).astype("<u2")
    return found


def _filled(luma: Values, mask: Values) -> Values:
    """Luma with even sides, whose pixels without depth take the value left of them, so that they make no edges."""
    height, width = luma.shape
    index = np.maximum.accumulate(np.where(mask, np.arange(width), 0), axis=1)
    filled = np.take_along_axis(luma, index, 1)
    return np.pad(filled, ((0, height % 2), (0, width % 2)), mode="edge")


def _cells(mask: Values, cell: int) -> bytes:
    """Which blocks have depth in most of their pixels, 8 in a byte.

    :param cell: pixels of the side of a block
    """
    height, width = mask.shape
    padded = np.pad(mask, ((0, -height % cell), (0, -width % cell)))
    down, across = (side // cell for side in padded.shape)
    counts = padded.reshape(down, cell, across, cell).sum((1, 3))
    return np.packbits(counts > cell * cell // 2).tobytes()


def _differences(values: Values, mask: Values) -> bytes:
    """The mask; differences to the value before, in a byte each; those that need more, in two bytes."""
    change = np.diff(values, prepend=0)
    folded = (change << 1 ^ change >> 31).astype("<u2")
    small = np.minimum(folded, 255).astype(np.uint8)
    return np.packbits(mask).tobytes() + small.tobytes() + folded[folded >= 255].tobytes()


def _from_differences(data: bytes, width: int, height: int) -> tuple[Values, Values]:
    flags, rest = take(data, -(-width * height // 8))
    mask = np.unpackbits(np.frombuffer(flags, np.uint8))[: width * height].astype(bool).reshape(height, width)
    small, large = take(rest, int(np.count_nonzero(mask)))
    folded = np.frombuffer(small, np.uint8).astype(np.int32)
    long = folded == 255
    if 2 * np.count_nonzero(long) != len(large):
        raise DamagedError("damaged depth: differences are missing")
    folded[long] = np.frombuffer(large, "<u2")
    return mask, np.cumsum(folded >> 1 ^ -(folded & 1))
