"""What a node replies about a type: a description with the asked hash, or a DescriptionError, in bounded time."""

from __future__ import annotations

from functools import partial

from fuzz.loop import main, within
from gr_ros2.core.errors import DescriptionError
from gr_ros2.middleware.type_descriptions import read_reply
from tests.middleware.describing import CUSTOM, CUSTOM_TEXT, STORE, hash_of_text, reply, types_of

BASE, PER_BYTE = 30_000, 10
"""Lines of Python for a reply, and more for each byte of it. One is read per type, in a thread that nothing waits
for."""
_DIGEST = hash_of_text(CUSTOM_TEXT)
_TYPES = ("nav_msgs/msg/Odometry", "visualization_msgs/msg/MarkerArray", "rcl_interfaces/msg/ParameterEvent")


def type_description(data: bytes) -> None:
    """The reply to a request for the custom type."""
    within(BASE + PER_BYTE * len(data), partial(_read, data))


def _read(data: bytes) -> None:
    try:
        described = read_reply(data, CUSTOM, _DIGEST)
    except DescriptionError:
        return
    assert described.types.keys() >= {CUSTOM, "std_msgs/msg/Header"}


def corpus() -> list[bytes]:
    """Replies about types of ROS and about the custom one."""
    found = [b"", bytes(8), reply(types_of(CUSTOM_TEXT), CUSTOM)]
    found.append(reply(types_of(CUSTOM_TEXT), CUSTOM, failure="not here"))
    return found + [reply(STORE.fielddefs, name) for name in _TYPES]


if __name__ == "__main__":
    main(type_description, corpus())
