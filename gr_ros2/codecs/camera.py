"""The codec of pictures that are looked at: H.264 within a budget for each frame.

An image is resized to what its budget is enough for (``sizes``). What comes out has the size that was sent, in the type
and encoding that came in, or as one of three types of compressed pictures; ``scaled_camera_info`` fits a CameraInfo.

Invariants: stamp and frame of the header stay; depth, and any encoding that is not in ``ENCODINGS``, is not made a
picture (UnfitError); frames form a chain, and one that is missing is never concealed.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any, NamedTuple

import av
import numpy as np
from av.video.reformatter import VideoReformatter

from gr_ros2.codecs import video
from gr_ros2.codecs.base import MAX_SIZE, Coded
from gr_ros2.codecs.h264 import Pixels
from gr_ros2.codecs.messages import (
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    IMAGE,
    PACKET,
    VIDEO,
    Origin,
    header_of,
    read,
    stamp_of,
    store,
    take_text,
    text,
    write,
)
from gr_ros2.codecs.sizes import AUTO, FULL, MAX_PIXELS, FittingSize, blocks, halved
from gr_ros2.codecs.video import VideoDecoder, VideoEncoder
from gr_ros2.compression.zstd_frames import read_varint
from gr_ros2.core.errors import ConfigError, DamagedError, OtherKindError, UnfitError
from gr_ros2.wire import varint

_BAYER = "bayer"
ENCODINGS = {
    "rgb8": ("rgb24", 3),
    "bgr8": ("bgr24", 3),
    "8UC3": ("bgr24", 3),
    "rgba8": ("rgba", 4),
    "bgra8": ("bgra", 4),
    "mono8": ("gray", 1),
    "8UC1": ("gray", 1),
    "yuv422": ("uyvy422", 2),
    "uyvy": ("uyvy422", 2),
    "yuv422_yuy2": ("yuyv422", 2),
    "yuyv": ("yuyv422", 2),
    "bayer_rggb8": ("bayer_rggb8", 1),
    "bayer_bggr8": ("bayer_bggr8", 1),
    "bayer_gbrg8": ("bayer_gbrg8", 1),
    "bayer_grbg8": ("bayer_grbg8", 1),
}
"""ROS's name of an encoding: FFmpeg's, and bytes of a pixel."""
OUTPUTS = {"CompressedImage": COMPRESSED_IMAGE, "CompressedVideo": VIDEO, "FFMPEGPacket": PACKET}
"""Types that come out where they are asked for."""
SAME = "same"
_USUAL_PER_BLOCK = 8
"""Bytes where no budget is given."""
_MOST_SEEN = 1 << 25
"""Pixels of a picture of this robot's camera; those that leave are fewer."""
_FORM = 1


@dataclass(frozen=True)
class CameraCodec:
    """Pictures as H.264 within a budget.

    :param size: 'auto', 'full', or the most pixels as '320x240'
    :param output: 'same', or the type that comes out: CompressedImage, CompressedVideo or FFMPEGPacket
    """

    type_name: str
    size: str = AUTO
    output_type: str = SAME

    def __post_init__(self) -> None:
        if self.size not in (AUTO, FULL) and not re.fullmatch(r"[1-9]\d{0,4}x[1-9]\d{0,4}", self.size):
            raise ConfigError(f"camera: size is {self.size!r}; it takes auto, full, or pixels such as 320x240")
        if self.output_type != SAME and self.output_type not in OUTPUTS:
            raise ConfigError(f"camera: output_type is {self.output_type!r}; it takes same, {', '.join(OUTPUTS)}")

    def encoder(self) -> CameraEncoder:
        return CameraEncoder(self)

    def decoder(self, max_size: int = MAX_SIZE) -> CameraDecoder:
        return CameraDecoder(self, max_size)

    @property
    def output(self) -> str:
        return OUTPUTS.get(self.output_type, self.type_name)


class _Picture(NamedTuple):
    """:param frame: the picture, and at most a row and a column more where they are odd
    :param label: encoding, or format of a compressed image
    """

    origin: Origin
    frame: av.VideoFrame
    width: int
    height: int
    label: str


class CameraEncoder:
    """Pictures to frames."""

    def __init__(self, options: CameraCodec) -> None:
        self._options = options
        self._video = VideoEncoder(_FORM)
        self._resize = VideoReformatter()
        self._size = FittingSize(options.size)

    def encode(self, message: bytes, budget: int | None = None, key: bool = False) -> Coded:
        picture = _compressed(message) if self._options.type_name == COMPRESSED_IMAGE else _image(message)
        width, height = picture.width, picture.height
        if budget is None:
            budget = _USUAL_PER_BLOCK * blocks(width, height)
        bytes_each = ENCODINGS[picture.label][1] if self._options.output == IMAGE else 0
        times = self._size.halvings(width, height, bytes_each, budget, key)
        shown = halved(width, height, times)
        frame = picture.frame
        if frame.format.name.startswith(_BAYER):
            frame = self._resize.reformat(frame, format="rgb24")
        coded = self._resize.reformat(frame, _even(shown[0]), _even(shown[1]), "yuv420p", interpolation="AREA")
        head = b"".join([*map(varint, shown), text(picture.label), text(picture.origin.frame_id)])
        said = f"H.264 of {shown[0]} × {shown[1]} pixels" + f", of {width} × {height}" * bool(times)
        said += ", without alpha" * any(component.is_alpha for component in picture.frame.format.components)
        return self._video.encode(coded, head, picture.origin.stamp(), budget, key)._replace(said=said)

    def confirmed(self, name: int) -> None:
        """Do nothing: no frame needs a confirmed one."""


class CameraDecoder:
    """Frames back to messages."""

    def __init__(self, options: CameraCodec, max_size: int) -> None:
        self._options, self._max_size = options, max_size
        self.size: tuple[int, int] | None = None
        """Width and height of the newest picture."""
        self._video = VideoDecoder(min(MAX_PIXELS, max_size) if options.output == IMAGE else MAX_PIXELS)
        self._resize = VideoReformatter()

    def decode(self, data: bytes) -> bytes:
        output = self._options.output
        head, side, h264, picture, key = self._video.read(data, output not in (VIDEO, PACKET))
        width, at = read_varint(head)
        height, more = read_varint(head[at:])
        label, rest = take_text(head[at + more :])
        frame_id, _ = take_text(rest)
        stamp = stamp_of(side)
        if (_even(width), _even(height)) != self._video.size:
            raise DamagedError(f"damaged video: {width} × {height} pixels are not what was coded")
        self.size = width, height
        header, content = header_of(stamp, frame_id), np.frombuffer(h264, np.uint8)
        if output == VIDEO:
            return self._small(write(VIDEO, timestamp=stamp, frame_id=frame_id, data=content, format="h264"))
        if picture is None:
            packet = {"width": _even(width), "height": _even(height), "encoding": "h264", "flags": int(key)}
            ns = max(0, stamp.sec) * 1_000_000_000 + stamp.nanosec
            return self._small(write(PACKET, header=header, pts=ns, is_bigendian=False, data=content, **packet))
        if output == COMPRESSED_IMAGE:
            jpeg = video.packed("mjpeg", self._resize.reformat(picture, width, height, "yuvj420p"))
            content = np.frombuffer(jpeg, np.uint8)
            return self._small(write(output, header=header, format=_jpeg_label(label), data=content))
        rows = self._pixels(picture, width, height, label)
        size = {"height": height, "width": width, "step": rows.shape[1]}
        pixels = np.ascontiguousarray(rows).ravel()
        return self._small(write(IMAGE, header=header, encoding=label, is_bigendian=0, data=pixels, **size))

    def _pixels(self, picture: av.VideoFrame, width: int, height: int, label: str) -> Pixels:
        """The rows of an image in an encoding."""
        if label not in ENCODINGS:
            raise DamagedError(f"damaged video: encoding {label[:40]!r}")
        kind, size = ENCODINGS[label]
        if width * height * size > self._max_size:
            raise DamagedError(f"damaged video: {width} × {height} pixels, at most {self._max_size} bytes are accepted")
        if not kind.startswith(_BAYER):
            return video.to_rows(self._resize.reformat(picture, width, height, kind), width * size)
        colours = video.to_rows(self._resize.reformat(picture, width, height, "rgb24"), 3 * width)
        return _mosaic(colours.reshape(height, width, 3), label)

    def _small(self, message: bytes) -> bytes:
        if len(message) > self._max_size:
            raise DamagedError(f"damaged video: a message of {len(message)} bytes, at most {self._max_size}")
        return message


def scaled_camera_info(message: bytes, width: int, height: int) -> bytes:
    """A CameraInfo for the image after resizing; the same bytes where it has that size already.

    Pixel (u, v) of the original has its centre at ((u + .5) · width / original width - .5, …) of the new one.

    :param width, height: pixels of the new image
    :raises DamagedError: not a CameraInfo
    """
    info = read(CAMERA_INFO, message)
    if (info.width, info.height) == (width, height) or not info.width or not info.height:
        return message
    across, down = width / info.width, height / info.height
    scale = np.array([[across, 0, (across - 1) / 2], [0, down, (down - 1) / 2], [0, 0, 1]])
    info.k = (scale @ info.k.reshape(3, 3)).ravel()
    info.p = (scale @ info.p.reshape(3, 4)).ravel()
    roi = info.roi
    roi.x_offset, roi.width = round(roi.x_offset * across), round(roi.width * across)
    roi.y_offset, roi.height = round(roi.y_offset * down), round(roi.height * down)
    info.width, info.height = width, height
    return bytes(store().serialize_cdr(info, CAMERA_INFO))


def _image(message: bytes) -> _Picture:
    image = read(IMAGE, message)
    if image.encoding not in ENCODINGS:
        raise OtherKindError(f"image: encoding {image.encoding!r} is not one of pictures: {', '.join(ENCODINGS)}")
    kind, size = ENCODINGS[image.encoding]
    rows, width = rows_of(image, size, _MOST_SEEN), image.width
    if kind.startswith(_BAYER):
        rows, width = _whole_patterns(rows[:, :width]), _even(width)
    picture = video.from_rows(rows, width, kind)
    return _Picture(Origin(image.header), picture, image.width, image.height, str(image.encoding))


def rows_of(image: Any, size: int, most: int = MAX_PIXELS) -> Pixels:
    """The bytes of an image, shape (height, step).

    :param size: bytes of a pixel
    :param most: pixels
    :raises DamagedError: when they do not fit its size
    :raises UnfitError: for more pixels
    """
    fits = image.width and image.height and image.step >= image.width * size
    if not fits or len(image.data) < image.step * image.height:
        raise DamagedError(
            f"damaged image: {image.width} × {image.height} pixels {image.encoding}, rows of {image.step} bytes, do "
            f"not fit its {len(image.data)} bytes"
        )
    if image.width * image.height > most:
        raise UnfitError(f"image: {image.width} × {image.height} pixels are more than {most}")
    rows: Pixels = image.data[: image.step * image.height].reshape(image.height, image.step)
    return rows


def _compressed(message: bytes) -> _Picture:
    image = read(COMPRESSED_IMAGE, message)
    data = bytes(image.data)
    codec = {b"\xff\xd8": "mjpeg", b"\x89P": "png"}.get(data[:2])
    if codec is None or "compressedDepth" in image.format:
        raise OtherKindError(f"image: {len(data)} bytes of format {image.format!r} are not JPEG or PNG")
    picture = video.still(codec, data, _MOST_SEEN)
    if "16" in picture.format.name or "48" in picture.format.name or "64" in picture.format.name:
        raise UnfitError(f"image: format {image.format!r} with 16 bits for each colour ({picture.format.name})")
    return _Picture(Origin(image.header), picture, picture.width, picture.height, str(image.format))


def _whole_patterns(rows: Pixels) -> Pixels:
    """A Bayer image whose sides are even: FFmpeg's converter ends the process at an odd one.

    :raises UnfitError: for an image that is too small for a pattern
    """
    height, width = rows.shape
    if min(height, width) < 2:
        raise UnfitError(f"image: {width} × {height} pixels are no Bayer pattern")
    # Mirrored at the last pixel, so that the new one has the colour that the pattern has there.
    return np.pad(rows, ((0, height % 2), (0, width % 2)), mode="reflect")


def _mosaic(colours: Pixels, label: str) -> Pixels:
    """Of each pixel the colour that its place in a Bayer pattern has."""
    made = np.empty(colours.shape[:2], np.uint8)
    for place, letter in enumerate(label.removeprefix("bayer_")[:4]):
        row, column = divmod(place, 2)
        made[row::2, column::2] = colours[row::2, column::2, "rgb".index(letter)]
    return made


def _jpeg_label(label: str) -> str:
    """What a compressed image says of itself: as it came, or as image_transport says it."""
    if "jp" in label:
        return label
    return label.replace("png", "jpeg") if "png" in label else f"{label}; jpeg compressed bgr8"


def _even(pixels: int) -> int:
    return pixels + pixels % 2
