"""H.264 with a budget in bytes for each frame, and single pictures, by PyAV (FFmpeg's libraries).

Of the encoders that were tried only libx264 keeps a budget that changes with each frame, and only with a buffer (VBV)
of one frame: it is opened in constant bit rate at the greatest rate with ``bufsize`` below a frame, and told
``bit_rate`` = budget · 8 · frames/s before each frame. A frame has at most what the one before had, too: a greater
budget counts from the second frame on. A forced key frame would stay within the budget of the frame before, so a key
frame begins a new encoder.

Invariants: equal pictures and budgets give equal bytes; what comes out are slices and parameter sets, nothing else, and
nothing else is given to the decoder; the decoder's pictures have the size that it was made for, which bounds its memory
and time; whatever FFmpeg says of bytes is a DamagedError.
"""

from __future__ import annotations

import re
from fractions import Fraction
from typing import Any

import av
import numpy as np
import numpy.typing as npt

from gr_ros2.codecs.base import KEY_TIMES, Coded, frame, name_of, opened
from gr_ros2.codecs.messages import take
from gr_ros2.codecs.sizes import MAX_PIXELS
from gr_ros2.compression.zstd_frames import read_varint
from gr_ros2.core.errors import DamagedError, MissingFrameError
from gr_ros2.wire import varint

_FPS = 10
"""Nominal; the bit rate of a budget counts with it."""
_TOP = 40_000_000
"""bit/s; x264 stays in constant bit rate when it starts with the greatest, and no later rate may be above."""
_ASKED = 1.12
"""Times the budget is asked for: a frame comes out at .98 of its budget in the median then, and 1.08 at 99 %."""
_LEAST = 1000
"""bit/s."""
_FIRSTS, _ENOUGH = 5, 0.2
"""Times that a key frame is made at most, and the part of its budget that is enough: who joins waits for it."""
_X264 = {
    "preset": "veryfast",
    "tune": "zerolatency",
    "maxrate": str(_TOP),
    "bufsize": "1000",
    "x264-params": "scenecut=0:rc-lookahead=0:keyint=infinite:ref=1:bframes=0:sliced-threads=0",
}
_MARGIN = 128
"""Pixels by which FFmpeg's memory of a picture is wider and higher, at most."""
_START = re.compile(rb"\x00\x00\x00?\x01")
_SLICE, _KEY_SLICE, _SEQUENCE, _PICTURE = 1, 5, 7, 8
_CARRIED = (_SLICE, _KEY_SLICE, _SEQUENCE, _PICTURE)
"""Types of the units of H.264 that are carried. x264's own name, in 600 bytes of each key frame, is not."""
Pixels = npt.NDArray[Any]


def units(data: bytes) -> bytes:
    """The units of H.264 that are carried, each behind a start code; b'' where there is none."""
    found = [unit for unit in _START.split(data)[1:] if unit and unit[0] & 31 in _CARRIED]
    return b"".join(b"\0\0\0\1" + unit for unit in found)


class H264Encoder:
    """Frames from a key frame on.

    :param width, height: pixels, both even
    """

    def __init__(self, width: int, height: int) -> None:
        made: Any = av.CodecContext.create("libx264", "w")
        made.width, made.height, made.pix_fmt = width, height, "yuv420p"
        made.time_base, made.framerate, made.thread_count = Fraction(1, _FPS), Fraction(_FPS), 1
        made.bit_rate = _TOP
        made.options = dict(_X264)
        self._context, self._count = made, 0

    def encode(self, picture: av.VideoFrame, budget: int) -> bytes:
        """One frame.

        :param picture: yuv420p of this encoder's size
        :param budget: bytes
        """
        if not self._context.is_open:
            self._context.open()
        self._context.bit_rate = min(_TOP, max(_LEAST, int(budget * _ASKED * 8 * _FPS)))
        picture.pts = self._count
        picture.time_base = self._context.time_base
        self._count += 1
        return units(b"".join(bytes(packet) for packet in self._context.encode(picture)))


def first_frame(picture: av.VideoFrame, budget: int) -> tuple[H264Encoder, bytes]:
    """A key frame and the encoder that goes on from it. Of a few hundred bytes x264 takes some dozen for its first
    frame, which is nearly grey, so it is asked again for as many more as are missing to half of them."""
    asked, best = budget, None
    for _ in range(_FIRSTS):
        encoder = H264Encoder(picture.width, picture.height)
        data = encoder.encode(picture, asked)
        if best is None or len(best[1]) < len(data) <= budget:
            best = encoder, data
        if len(data) >= _ENOUGH * budget:
            break
        asked += budget // 2 - len(data)
    assert best is not None
    return best


class H264Decoder:
    """Pictures of one chain of frames.

    :param width, height: pixels, both even
    """

    def __init__(self, width: int, height: int) -> None:
        self._size = width, height
        self._context = _reader("h264", (width + _MARGIN) * (height + _MARGIN))

    def decode(self, data: bytes) -> av.VideoFrame:
        """The picture of a frame, yuv420p.

        :raises DamagedError: bytes that are not exactly one whole frame of this size
        """
        pictures = _decoded(self._context, units(data))
        if len(pictures) != 1 or (pictures[0].width, pictures[0].height) != self._size or pictures[0].is_corrupt:
            raise DamagedError("damaged video: not one frame of its size")
        return pictures[0]


def still(codec: str, data: bytes, most: int = MAX_PIXELS) -> av.VideoFrame:
    """A picture that stands alone.

    :param codec: 'mjpeg' or 'png'
    :param most: pixels
    :raises DamagedError: not such a picture, cut short, or of more pixels
    """
    # FFmpeg takes a JPEG whose last bytes are missing: the end of the picture stands behind its last scan.
    cut = codec == "mjpeg" and data.rfind(b"\xff\xd9") < data.rfind(b"\xff\xda")
    pictures = [] if cut else _decoded(_reader(codec, most), data)
    if len(pictures) != 1 or pictures[0].is_corrupt:
        raise DamagedError(f"damaged image: not one whole {codec} picture")
    return pictures[0]


def packed(codec: str, picture: av.VideoFrame, quality: int = 3) -> bytes:
    """A picture as JPEG or PNG.

    :param codec: 'mjpeg' or 'png'
    :param quality: of JPEG, 1 = best to 31
    """
    made: Any = av.CodecContext.create(codec, "w")
    made.width, made.height, made.pix_fmt = picture.width, picture.height, picture.format.name
    made.time_base = Fraction(1, _FPS)
    made.options = {"qmin": str(quality), "qmax": str(quality), "strict": "unofficial"}
    made.thread_count = 1
    picture.pts, picture.time_base = 0, made.time_base
    return b"".join(bytes(packet) for packet in [*made.encode(picture), *made.encode(None)])


def _reader(codec: str, most: int) -> Any:
    made: Any = av.CodecContext.create(codec, "r")
    made.thread_count = 1
    made.options = {"flags": "low_delay", "err_detect": "explode", "max_pixels": str(most)}
    return made


def _decoded(context: Any, data: bytes) -> list[av.VideoFrame]:
    try:
        return list(context.decode(av.Packet(data)))
    except (av.error.FFmpegError, ValueError, MemoryError) as error:
        raise DamagedError(f"damaged video: {' '.join(str(error).split())}") from error


def from_rows(rows: Pixels, width: int, kind: str) -> av.VideoFrame:
    """A picture of one plane.

    :param rows: uint8, shape (height, bytes of a row); bytes behind those of the pixels are left out
    :param kind: FFmpeg's name of the pixel format
    """
    made = av.VideoFrame(width, len(rows), kind)
    _fill(made.planes[0], rows)
    return made


def to_rows(picture: av.VideoFrame, row: int, plane: int = 0) -> Pixels:
    """The bytes of a plane, shape (rows, ``row``)."""
    source: Any = picture.planes[plane]
    return np.frombuffer(source, np.uint8).reshape(-1, source.line_size)[: source.height, :row]


def from_luma(luma: Pixels) -> av.VideoFrame:
    """A grey picture whose luma is exactly this, yuv420p; both sides even."""
    made = av.VideoFrame(luma.shape[1], luma.shape[0], "yuv420p")
    grey = np.full((luma.shape[0] // 2, luma.shape[1] // 2), 128, np.uint8)
    for plane, values in zip(made.planes, (luma, grey, grey), strict=True):
        _fill(plane, values)
    return made


def _fill(plane: Any, rows: Pixels) -> None:
    size = plane.line_size
    if rows.shape == (plane.height, size) and rows.flags.c_contiguous:
        plane.update(rows.data.cast("B"))
        return
    whole = np.zeros((plane.height, size), np.uint8)
    across = min(size, rows.shape[1])
    whole[:, :across] = rows[:, :across]
    plane.update(whole)


class VideoEncoder:
    """A chain of frames: each names the one before; a key frame begins when it is asked for, and when the head changes.

    The body of a frame is the fixed part, then its variable part, then video. The fixed part, which stands in key
    frames only, is the size and what the codec says there (the head).

    :param form: of the frames
    """

    def __init__(self, form: int) -> None:
        self._form = form
        self._fixed = b""
        self._video: H264Encoder | None = None
        self._last: int | None = None

    def encode(self, picture: av.VideoFrame, head: bytes, side: bytes, budget: int, key: bool) -> Coded:
        """A frame.

        :param picture: yuv420p, both sides even
        :param head: what all frames of a chain have in common
        :param side: what this frame carries beside the picture
        :param budget: bytes of the whole frame where it is no key frame
        """
        fixed = varint(picture.width) + varint(picture.height) + varint(len(head)) + head
        if key or fixed != self._fixed:
            self._video = None
        before, self._last = self._last if self._video is not None else None, None
        body = (b"" if before is not None else fixed) + varint(len(side)) + side
        try:
            if self._video is not None:
                data = self._video.encode(picture, max(0, budget - len(body) - 5))
            else:
                self._fixed = fixed
                self._video, data = first_frame(picture, max(0, KEY_TIMES * budget - len(body)))
        except (av.error.FFmpegError, ValueError) as error:
            self._video = None
            raise DamagedError(f"image: the encoder refuses it ({error})") from error
        coded = frame(self._form, body + data, before)
        self._last = coded.name
        return coded


class VideoDecoder:
    """The other end of a VideoEncoder.

    :param most: pixels of the largest picture
    """

    def __init__(self, most: int = MAX_PIXELS) -> None:
        self._most = most
        self._size = 0, 0
        self._head = b""
        self._video: H264Decoder | None = None
        self._last: int | None = None

    def read(self, data: bytes, decode: bool = True) -> tuple[bytes, bytes, bytes, av.VideoFrame | None, bool]:
        """(head, side, H.264, the picture, whether it is a key frame) of a frame.

        :param decode: False: no picture is made, for those who pass H.264 on
        :raises DamagedError: not such a frame
        :raises MissingFrameError: the frame before was not decoded
        """
        last, self._last = self._last, None  # until this one is decoded
        _, before, body = opened(data)
        if before is None:
            width, body = _number(body)
            height, body = _number(body)
            length, body = _number(body)
            if not (width and height) or width % 2 or height % 2 or width * height > self._most:
                raise DamagedError(f"damaged video: {width} × {height} pixels, at most {self._most} are accepted")
            self._head, body = take(body, length)
            self._size = width, height
            self._video = H264Decoder(width, height) if decode else None
        elif before != last:
            raise MissingFrameError("video: the frame before this one was not decoded; a key frame will follow")
        length, body = _number(body)
        side, h264 = take(body, length)
        picture = self._video.decode(h264) if self._video is not None else None
        self._last = name_of(data)
        return self._head, side, units(h264), picture, before is None

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the newest picture, pixels."""
        return self._size


def _number(data: bytes) -> tuple[int, bytes]:
    value, at = read_varint(data)
    return value, data[at:]
