"""Chains of frames of video, and single pictures, by PyAV (FFmpeg's libraries).

Invariants: a chain begins with a key frame, and each other frame names the one before; whatever FFmpeg says of bytes is
a DamagedError.
"""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import av
import numpy as np

from gr_ros2.codecs.base import KEY_TIMES, Coded, frame, name_of, opened
from gr_ros2.codecs.h264 import START, H264Decoder, H264Encoder, Pixels, decoded, fill_plane, reader, units
from gr_ros2.codecs.messages import take
from gr_ros2.codecs.sizes import MAX_PIXELS
from gr_ros2.compression.zstd_frames import read_varint
from gr_ros2.core.errors import DamagedError, MissingFrameError
from gr_ros2.wire import varint

_FPS = 10
"""Nominal, of a single picture."""
_OUTER = 1
"""Bytes of a frame beside its body and its H.264: the first start code, which is left out, is as long as a name."""


def still(codec: str, data: bytes, most: int = MAX_PIXELS) -> av.VideoFrame:
    """A picture that stands alone.

    :param codec: 'mjpeg' or 'png'
    :param most: pixels
    :raises DamagedError: not such a picture, cut short, or of more pixels
    """
    # FFmpeg takes a JPEG whose last bytes are missing: the end of the picture stands behind its last scan.
    cut = codec == "mjpeg" and data.rfind(b"\xff\xd9") < data.rfind(b"\xff\xda")
    pictures = [] if cut else decoded(reader(codec, most), data)
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


def from_rows(rows: Pixels, width: int, kind: str) -> av.VideoFrame:
    """A picture of one plane.

    :param rows: uint8, shape (height, bytes of a row); bytes behind those of the pixels are left out
    :param kind: FFmpeg's name of the pixel format
    """
    made = av.VideoFrame(width, len(rows), kind)
    fill_plane(made.planes[0], rows)
    return made


def to_rows(picture: av.VideoFrame, row: int) -> Pixels:
    """The bytes of the first plane, shape (rows, ``row``)."""
    source: Any = picture.planes[0]
    return np.frombuffer(source, np.uint8).reshape(-1, source.line_size)[: source.height, :row]


def from_luma(luma: Pixels) -> av.VideoFrame:
    """A grey picture whose luma is exactly this, yuv420p; both sides even."""
    made = av.VideoFrame(luma.shape[1], luma.shape[0], "yuv420p")
    grey = np.full((luma.shape[0] // 2, luma.shape[1] // 2), 128, np.uint8)
    for plane, values in zip(made.planes, (luma, grey, grey), strict=True):
        fill_plane(plane, values)
    return made


class VideoEncoder:
    """A chain of frames: each names the one before; a key frame begins when it is asked for, and when the head changes.

    The body of a frame is the fixed part, then its variable part, then video without its first start code. The fixed
    part, which stands in key frames only, is the size and what the codec says there (the head).

    :param form: of the frames
    """

    def __init__(self, form: int) -> None:
        self._form = form
        self._fixed = b""
        self._video: H264Encoder | None = None
        self._last: int | None = None
        self._since = KEY_TIMES
        """Frames since the last key frame, and so the budgets that the next may have: two cameras that publish as one
        would take four times what is free."""

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
            if self._video is None:
                self._fixed, self._video = fixed, H264Encoder(picture.width, picture.height)
                budget *= min(self._since, KEY_TIMES)
                self._since = 0
            self._since += 1
            data = self._video.encode(picture, max(0, budget - len(body) - _OUTER))
        except (av.error.FFmpegError, ValueError) as error:
            self._video = None
            raise DamagedError(f"image: the encoder refuses it ({error})") from error
        coded = frame(self._form, body + data.removeprefix(START), before)
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
        h264 = units(START + h264)
        picture = self._video.decode(h264) if self._video is not None else None
        self._last = name_of(data)
        return self._head, side, h264, picture, before is None

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the newest picture, pixels."""
        return self._size


def _number(data: bytes) -> tuple[int, bytes]:
    value, at = read_varint(data)
    return value, data[at:]
