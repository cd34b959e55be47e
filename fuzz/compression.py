"""The receiving half of the message codec: any bytes give a message or a CodecError, with work that grows with them.

The codec is new for every input, so that nothing is remembered: the first message of its kind is the dearest.
"""

from __future__ import annotations

import random
from functools import partial

from fuzz.loop import main, within
from gr_ros2.compression import LinkCodec
from gr_ros2.core.errors import CodecError
from gr_ros2.settings.registry import Registry, Topic
from gr_ros2_lab.sim.fleet import Fleet
from gr_ros2_lab.sim.sensors import TYPES as SIMULATED
from gr_ros2_lab.sim.sim_settings import SimSettings

BASE, PER_BYTE = 20_000, 500
"""Lines of Python that a coded message may take, and more for each byte of it."""
_OTHERS = (
    "std_msgs/msg/String", "std_msgs/msg/Float32MultiArray", "std_msgs/msg/Int16MultiArray", "my_msgs/msg/Thing",
    "geometry_msgs/msg/PoseArray", "visualization_msgs/msg/MarkerArray", "diagnostic_msgs/msg/DiagnosticArray",
    "sensor_msgs/msg/CameraInfo", "visualization_msgs/msg/InteractiveMarkerUpdate",
)  # fmt: skip
TYPES = (*sorted(set(SIMULATED.values())), *_OTHERS)
_REGISTRY = Registry.from_rows({f"topic_{number}": name for number, name in enumerate(TYPES)})
_MAX_SIZE = 1 << 20


def compression(data: bytes) -> None:
    """The first byte chooses the topic, the rest is the coded message."""
    topic_id, coded = (data[0] if data else 0) % len(TYPES), data[1:]
    one = Registry([Topic(0, "topic", TYPES[topic_id])])
    within(BASE + PER_BYTE * len(coded), partial(_decode, LinkCodec(one, max_size=_MAX_SIZE), coded))


def _decode(codec: LinkCodec, coded: bytes) -> None:
    try:
        message = codec.decode(0, coded)
    except CodecError as error:
        assert error.fate in ("damaged", "unsupported", "unknown_dictionary")
        return
    assert len(message) <= _MAX_SIZE


def corpus() -> list[bytes]:
    """What a sender codes of the simulator's messages, next to nothing, and messages that claim to be large."""
    rng = random.Random(3)
    codec = LinkCodec(_REGISTRY, max_size=_MAX_SIZE)
    found = [b"", b"\0"]
    seen: dict[str, int] = {}
    for message in Fleet(SimSettings(robots=1, map_rate=1.0)).messages(2.0, 1.7e9):
        topic = message.topic.rsplit("/", 1)[-1]
        seen[topic] = seen.get(topic, 0) + 1
        if topic in SIMULATED and seen[topic] <= 3:
            number = TYPES.index(SIMULATED[topic])
            found.append(bytes([number]) + codec.encode(number, message.payload))
    for number in range(len(TYPES)):
        head = bytes([number])
        found += [head + bytes([first]) + rng.randbytes(30) for first in (0x01, 0x11, 0x12, 0x12, 0x12, 0x13)]
        found += [head + codec.encode(number, bytes(1_000_000)), head + b"\x12" + b"\xff" * 30]
    return found


if __name__ == "__main__":
    main(compression, corpus())
