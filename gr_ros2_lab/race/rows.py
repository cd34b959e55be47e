"""The rows of a race of two: what happens beside the odometry of the robot that sends.

Invariants: of a row all contenders carry the same contents at the same times. What goes beside the odometry is random
bytes, which no contender can compress; only a camera's pictures become what each one's users send.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

import numpy as np

from gr_ros2.codecs import video
from gr_ros2.codecs.messages import COMPRESSED_IMAGE, IMAGE, header_of, read, store, write
from gr_ros2.middleware import Qos

RowName = Literal["steady", "outage-5", "outage-30", "late", "map", "camera"]
BLOB = "std_msgs/msg/UInt8MultiArray"
LATCHED = Qos("reliable", "transient_local", 1)
SENSOR = Qos("best_effort", "volatile", 5)
_WIDTH, _HEIGHT, _FPS = 320, 240, 10
_LUMA = np.array([0.299, 0.587, 0.114])
"""ITU-R BT.601."""
_JPEG_QSCALE = 8
"""MJPEG's scale of quantization that comes nearest to quality 50 of libjpeg."""


class RowMessage(NamedTuple):
    """A message beside the odometry, s after its first one."""

    t: float
    topic: str
    payload: bytes


class Beside(NamedTuple):
    """A topic beside the odometry."""

    topic: str
    type_name: str
    qos: Qos


@dataclass(frozen=True)
class RaceRow:
    """What happens, and what a race of it is set to unless it is told otherwise.

    :param outage_s: s for which nothing passes, from ``begin_s`` on
    :param begin_s: s from the first odometry message to what happens: an outage, the listener's joining, a message
    :param late: the receiving robot joins so late, with all it has
    :param latched: sizes of what is published once, reliable and for late joiners: at the start if the listener is late
    :param camera: a camera beside it
    :param settings: of :class:`RaceSettings`
    """

    summary: str
    outage_s: float = 0.0
    begin_s: float = 4.0
    late: bool = False
    latched: tuple[int, ...] = ()
    camera: bool = False
    settings: dict[str, Any] = field(default_factory=dict)

    def topics(self, stack: str) -> tuple[Beside, ...]:
        """The topics beside the odometry, as a contender of this stack has them."""
        if self.camera:
            raw, kind = stack == "gr-ros2", (COMPRESSED_IMAGE, IMAGE)
            return (Beside("/robot_1/camera/image" + ("" if raw else "/compressed"), kind[raw], SENSOR),)
        return tuple(Beside(f"/robot_1/blob_{number}", BLOB, LATCHED) for number, _ in enumerate(self.latched))

    def offers(self, stack: str, duration_s: float) -> Iterator[RowMessage]:
        """What is published on these topics, topic by topic."""
        topics = self.topics(stack)
        for number, size in enumerate(self.latched):
            yield RowMessage(0.0 if self.late else self.begin_s, topics[number].topic, blob(number, size))
        for number in range(int(duration_s * _FPS) if self.camera else 0):
            yield RowMessage(number / _FPS, topics[0].topic, picture(number, compressed=topics[0].type_name != IMAGE))


ROWS: dict[str, RaceRow] = {
    "steady": RaceRow("odometry alone"),
    "outage-5": RaceRow("nothing passes for 5 s", 5.0, settings={"load": (0.5,), "loss": (0.05,), "duration_s": 17.0}),
    "outage-30": RaceRow(
        "nothing passes for 30 s", 30.0, settings={"load": (0.5,), "loss": (0.05,), "duration_s": 46.0}
    ),
    "late": RaceRow(
        "a robot joins late and finds 5 latched messages of 1 MB",
        begin_s=2.0,
        late=True,
        latched=(1_000_000,) * 5,
        settings={"load": (0.1,), "loss": (0.05,), "duration_s": 42.0, "packet_len": 1400},
    ),
    "map": RaceRow(
        "a latched message of 200 kB beside the odometry",
        latched=(200_000,),
        settings={"load": (0.5,), "loss": (0.05,), "duration_s": 20.0, "packet_len": 220},
    ),
    "camera": RaceRow(
        "a camera of 320 x 240 at 10 pictures/s beside the odometry",
        camera=True,
        settings={"load": (0.25,), "loss": (0.05,), "duration_s": 10.0, "packet_len": 220},
    ),
}


def blob(number: int, size: int) -> bytes:
    """A ``BLOB`` of so many random bytes: what holds already compressed contents, a map's or a mesh's."""
    data = np.random.default_rng(number).integers(0, 256, size, np.uint8)
    types = store().types
    layout = types["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)
    return write(BLOB, layout=layout, data=data)


def view(number: int) -> Any:
    """What the camera sees, (height, width, 3) uint8: textured ground that passes, two boxes that move, noise."""
    y, x = np.mgrid[:_HEIGHT, :_WIDTH]
    shift, still = 4 * number, np.random.default_rng(1).integers(0, 48, (_HEIGHT, 4 * _WIDTH))
    grey = 90 + 40 * np.sin((x + shift) / 17) * np.cos(y / 13) + np.roll(still, -shift, 1)[:, :_WIDTH]
    for place, size, shade in (((60 + 3 * number) % 260, 40, 210), ((230 - 5 * number) % 260, 30, 30)):
        grey[80 : 80 + size, place : place + size] = shade
    grey = grey + np.random.default_rng([2, number]).normal(0, 2, grey.shape)
    return np.clip(grey[..., None] + np.array([10, 0, -10]), 0, 255).astype(np.uint8)


def picture(number: int, *, compressed: bool) -> bytes:
    """A picture of the camera: ``Image``, or as JPEG of quality 50 a ``CompressedImage``."""
    nanoseconds = round(number / _FPS * 1e9)
    time = store().types["builtin_interfaces/msg/Time"](nanoseconds // 10**9, nanoseconds % 10**9)
    header, pixels = header_of(time, "camera"), view(number)
    if not compressed:
        data = pixels.reshape(-1)
        return write(
            IMAGE,
            header=header,
            height=_HEIGHT,
            width=_WIDTH,
            encoding="rgb8",
            is_bigendian=0,
            step=3 * _WIDTH,
            data=data,
        )
    frame = video.from_rows(pixels.reshape(_HEIGHT, -1), _WIDTH, "rgb24").reformat(format="yuvj420p")
    jpeg = np.frombuffer(video.packed("mjpeg", frame, _JPEG_QSCALE), np.uint8)
    return write(COMPRESSED_IMAGE, header=header, format="rgb8; jpeg compressed bgr8", data=jpeg)


def number_of(payload: bytes) -> int:
    """Which picture of the camera a message is."""
    seconds, nanoseconds = (int.from_bytes(payload[at : at + 4], "little") for at in (4, 8))
    return round((seconds + nanoseconds * 1e-9) * _FPS)


def quality_db(number: int, payload: bytes) -> float:
    """PSNR of the brightness of a picture that came out, ``Image`` of any size or ``CompressedImage``, against what
    the camera saw, dB."""
    truth = view(number).astype(float) @ _LUMA
    if payload.find(b"rgb8; jpeg", 0, 64) >= 0:
        data = bytes(read(COMPRESSED_IMAGE, payload).data)
        luma = video.still("mjpeg", data).to_ndarray(format="rgb24") @ _LUMA
    else:
        out = read(IMAGE, payload)
        luma = out.data.reshape(out.height, out.width, 3) @ _LUMA
    high, wide = luma.shape
    shown = luma[np.arange(_HEIGHT) * high // _HEIGHT][:, np.arange(_WIDTH) * wide // _WIDTH]
    return float(10 * np.log10(255**2 / max(1e-9, float(((shown - truth) ** 2).mean()))))
