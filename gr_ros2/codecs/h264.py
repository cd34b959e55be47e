"""H.264 with a budget in bytes for each frame, by PyAV (FFmpeg's libraries and x264).

Of the encoders that were tried only x264 keeps a budget that changes with each frame, and only with a buffer (VBV) of
one frame: it is opened in constant bit rate at the greatest rate with ``bufsize`` below a frame, and told ``bit_rate``
before each frame. The buffer is a whole number of kilobits, which is too coarse for frames of a few hundred bytes. What
a budget is below it is filled with user data, which x264 counts before it codes the frame, and which is not carried:
FFmpeg takes such data with a picture, and the only pictures of PyAV that have any are decoded ones (:class:`_Filled`).

A frame has at most the buffer of the one before. So the buffer of small frames is somewhat larger than their mean. A
forced key frame would stay within it, so a key frame begins a new encoder.

Invariants: equal pictures and budgets give equal bytes; what comes out are slices and parameter sets, nothing else, and
nothing else is given to the decoder; the decoder's pictures have the size that it was made for, which bounds its memory
and time; whatever FFmpeg says of bytes is a DamagedError.
"""

from __future__ import annotations

import math
import re
from fractions import Fraction
from typing import Any

import av
import numpy as np
import numpy.typing as npt

from gr_ros2.core.errors import DamagedError

_FPS = 10
"""Nominal; the bit rate of a budget counts with it."""
_TOP = 40_000_000
"""bit/s; x264 stays in constant bit rate when it starts with the greatest, and no later rate may be above."""
_KILOBIT = 125
"""Bytes."""
_ASKED = 1.12
"""Times the budget is asked for: a frame comes out at .92 of its budget in the median then, and 1.07 at 99 %."""
_FILLED = 11 * _KILOBIT
"""Bytes of a budget below which whole kilobits are too coarse."""
_LARGER, _LATELY = 1.25, 0.125
"""Times the mean budget that the buffer of a small frame is at least, and the weight of the newest in the mean."""
_MOST_ASKED, _LESS = 1.22, 0.22
"""Times a small budget is asked for in a much larger buffer, and by how much less in one that it fills: a frame comes
out shorter in a larger one."""
_SMALL, _LONGER = 40_000, "fast"
"""Pixels of a picture up to which x264 searches longer: frames of 60 to 360 bytes are .6 dB better for .6 ms. At
640 × 480 it would be .1 dB, for 13 ms."""
_X264 = {
    "preset": "veryfast",
    "tune": "zerolatency",
    "maxrate": str(_TOP),
    "bufsize": "1000",
    "udu_sei": "1",
    "x264-params": "scenecut=0:rc-lookahead=0:keyint=infinite:ref=1:bframes=0:sliced-threads=0:vbv-init=1",
}
_GLOBAL_HEADER = 1 << 22
"""Parameter sets, and x264's own name of 600 bytes, are no part of the first frame."""
_MARGIN = 128
"""Pixels by which FFmpeg's memory of a picture is wider and higher, at most."""
START = b"\0\0\0\1"
_START = re.compile(rb"\x00\x00\x00?\x01")
_SLICE, _KEY_SLICE, _SEQUENCE, _PICTURE, _USER_DATA = 1, 5, 7, 8, 6
_CARRIED = (_SLICE, _KEY_SLICE, _SEQUENCE, _PICTURE)
"""Types of the units of H.264 that are carried."""
Pixels = npt.NDArray[Any]


def units(data: bytes) -> bytes:
    """The units of H.264 that are carried, each behind a start code; b'' where there is none."""
    found = [unit for unit in _START.split(data)[1:] if unit and unit[0] & 31 in _CARRIED]
    return b"".join(START + unit for unit in found)


class H264Encoder:
    """Frames from a key frame on.

    :param width, height: pixels, both even
    """

    def __init__(self, width: int, height: int) -> None:
        made: Any = av.CodecContext.create("libx264", "w")
        made.width, made.height, made.pix_fmt = width, height, "yuv420p"
        made.time_base, made.framerate, made.thread_count = Fraction(1, _FPS), Fraction(_FPS), 1
        made.flags |= _GLOBAL_HEADER
        made.bit_rate = _TOP
        made.options = _X264 | ({"preset": _LONGER} if width * height <= _SMALL else {})
        self._context, self._count = made, 0
        self._mean = 0.0
        self._key = b""
        self._filled: _Filled | None = None

    def encode(self, picture: av.VideoFrame, budget: int) -> bytes:
        """One frame.

        :param picture: yuv420p of this encoder's size
        :param budget: bytes
        """
        if self._count:
            return self._coded(*self._within(picture, budget))
        self._context.open()
        sets = units(bytes(self._context.extradata))
        self._key = sets + self._coded(picture, budget - len(sets))
        return self._key

    def _within(self, picture: av.VideoFrame, budget: int) -> tuple[av.VideoFrame, float]:
        """The picture with what fills the buffer, and the bytes of the buffer."""
        self._mean += (budget - self._mean) * (_LATELY if self._mean else 1)
        if budget >= _FILLED:
            return picture, _ASKED * budget
        kilobits = math.ceil(max(_ASKED * budget, _LARGER * self._mean, 1) / _KILOBIT)
        buffer = kilobits * _KILOBIT
        fill = round(buffer - (_MOST_ASKED - _LESS * budget / buffer) * budget)
        if fill < _Filled.LEAST / 2:
            return picture, buffer
        if self._filled is None:
            self._filled = _Filled(self._context.width, self._context.height, self._key)
        return self._filled.picture(picture, fill), buffer

    def _coded(self, picture: av.VideoFrame, buffer: float) -> bytes:
        self._context.bit_rate = min(_TOP, max(1000, int(buffer * 8)) * _FPS)
        picture.pts = self._count
        picture.time_base = self._context.time_base
        self._count += 1
        return units(b"".join(bytes(packet) for packet in self._context.encode(picture)))


class _Filled:
    """Pictures with user data, which FFmpeg gives to x264 and x264 counts.

    :param key: a key frame of the size of the pictures
    """

    LEAST = 25
    """Bytes of user data that x264 counts at least: an identifier of 16, and what is around it."""

    def __init__(self, width: int, height: int, key: bytes) -> None:
        self._decoder, self._key = H264Decoder(width, height), key

    def picture(self, picture: av.VideoFrame, fill: int) -> av.VideoFrame:
        """The picture.

        :param fill: bytes that x264 counts
        """
        size = 16 + max(0, fill - self.LEAST)
        length = b"\xff" * (size // 255) + bytes([size % 255])
        unit = bytes([_USER_DATA, 5]) + length + b"\1" * size + b"\x80"
        made = self._decoder.decode_units(START + unit + self._key)
        made.make_writable()
        sources: Any = picture.planes
        for plane, source in zip(made.planes, sources, strict=True):
            rows = np.frombuffer(source, np.uint8).reshape(-1, source.line_size)
            fill_plane(plane, rows[: plane.height, : plane.width])
        made.pict_type = av.video.frame.PictureType.NONE
        return made


class H264Decoder:
    """Pictures of one chain of frames.

    :param width, height: pixels, both even
    """

    def __init__(self, width: int, height: int) -> None:
        self._size = width, height
        self._context = reader("h264", (width + _MARGIN) * (height + _MARGIN))

    def decode(self, data: bytes) -> av.VideoFrame:
        """The picture of a frame, yuv420p.

        :raises DamagedError: bytes that are not exactly one whole frame of this size
        """
        return self.decode_units(units(data))

    def decode_units(self, data: bytes) -> av.VideoFrame:
        """The same of units of any type."""
        pictures = decoded(self._context, data)
        if len(pictures) != 1 or (pictures[0].width, pictures[0].height) != self._size or pictures[0].is_corrupt:
            raise DamagedError("damaged video: not one frame of its size")
        return pictures[0]


def reader(codec: str, most: int) -> Any:
    """FFmpeg's decoder.

    :param most: pixels of its memory of a picture
    """
    made: Any = av.CodecContext.create(codec, "r")
    made.thread_count = 1
    made.options = {"flags": "low_delay", "err_detect": "explode", "max_pixels": str(most)}
    return made


def decoded(context: Any, data: bytes) -> list[av.VideoFrame]:
    """The pictures of bytes.

    :raises DamagedError: what FFmpeg says
    """
    try:
        return list(context.decode(av.Packet(data)))
    except (av.error.FFmpegError, ValueError, MemoryError) as error:
        raise DamagedError(f"damaged video: {' '.join(str(error).split())}") from error


def fill_plane(plane: Any, rows: Pixels) -> None:
    """Put pixels into a plane of a picture.

    :param rows: uint8, shape (height, bytes of a row); bytes behind those of the plane are left out
    """
    size = plane.line_size
    if rows.shape == (plane.height, size) and rows.flags.c_contiguous:
        plane.update(rows.data.cast("B"))
        return
    whole = np.zeros((plane.height, size), np.uint8)
    across = min(size, rows.shape[1])
    whole[:, :across] = rows[:, :across]
    plane.update(whole)
