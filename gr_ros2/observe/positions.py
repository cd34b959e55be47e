"""Reads positions from serialized messages: which types have a position, and in which field.

Invariant: only types of ROS 2 Humble whose position is one point in metres count (no latitude and longitude); a payload
has no position if it cannot be deserialized, or if its position is not finite or is beyond ``FARTHEST_M``; the caller
counts such payloads.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, lru_cache
from operator import attrgetter
from typing import Any

from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from gr_ros2.middleware.type_definitions import DAMAGED

_POSITION_AT = {
    "geometry_msgs/msg/Point": "",
    "geometry_msgs/msg/PointStamped": "point",
    "geometry_msgs/msg/Pose": "position",
    "geometry_msgs/msg/PoseStamped": "pose.position",
    "geometry_msgs/msg/PoseWithCovariance": "pose.position",
    "geometry_msgs/msg/PoseWithCovarianceStamped": "pose.pose.position",
    "geometry_msgs/msg/TransformStamped": "transform.translation",
    "nav_msgs/msg/Odometry": "pose.pose.position",
}

FARTHEST_M = 1e9
"""A coordinate beyond this, more than twice the distance to the Moon, is not a position of a robot. It would also hide
every other point in a path's figures and means."""

_REMEMBERED = 1024
"""Messages of a type whose positions are kept: each robot of a run asks for that of every message it hears."""
PositionReader = Callable[[bytes], tuple[float, float] | None]


@cache
def humble_types() -> Typestore:
    """The message definitions of ROS 2 Humble."""
    return get_typestore(Stores.ROS2_HUMBLE)


@cache
def position_reader(type_name: str) -> PositionReader | None:
    """A function from a serialized message to its (x, y) in metres. The function returns None if the bytes are not a
    message of this type or have no valid position.

    :param type_name: ``package/msg/Type``
    :return: None where the type has no position
    """
    if type_name not in _POSITION_AT:
        return None
    where = _POSITION_AT[type_name]
    point_of: Callable[[Any], Any] = attrgetter(where) if where else lambda message: message
    deserialize = humble_types().deserialize_cdr

    @lru_cache(maxsize=_REMEMBERED)
    def read(payload: bytes) -> tuple[float, float] | None:
        try:
            point = point_of(deserialize(payload, type_name))
        except DAMAGED:
            return None
        x, y = float(point.x), float(point.y)
        return (x, y) if abs(x) <= FARTHEST_M and abs(y) <= FARTHEST_M else None  # NaN compares as False

    return read
