"""The transforms between the frames of a robot, published on ``/tf`` and ``/tf_static`` as robots do (REP 105).

Invariants: only the transform from the robot's odometry moves; all others are fixed. The odometry starts at the true
place, so ``odom`` and ``map`` coincide. Laser and IMU are in the middle of the robot.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Final

from rosbags.typesys import Stores, get_typestore

from gr_ros2.middleware.base import Middleware, Qos

TF_TYPE: Final = "tf2_msgs/msg/TFMessage"
_STORE: Final = get_typestore(Stores.ROS2_HUMBLE)
_TYPE: Final = _STORE.types
_WORLD: Final = "map"
_DEPTH: Final = 100


class TransformPublisher:
    """Publishes the transforms of one robot on a graph. All visualization tools need them.

    :param middleware: the robot's graph
    :param prefix: prefix of its frames, such as ``robot_1/``; ``''`` for none. With a prefix, the robot's own ``map``
        coincides with the ``map`` of all robots
    :raises MiddlewareError: when the topics cannot be announced
    """

    def __init__(self, middleware: Middleware, prefix: str) -> None:
        self._moving = middleware.advertise("/tf", TF_TYPE, Qos("reliable", "volatile", _DEPTH))
        self._fixed = middleware.advertise("/tf_static", TF_TYPE, Qos("reliable", "transient_local", 1))
        pairs = [("map", "odom"), ("base_link", "laser"), ("base_link", "imu_link")]
        fixed = [(f"{prefix}{parent}", f"{prefix}{child}") for parent, child in pairs]
        self._pairs = ([(_WORLD, f"{prefix}{_WORLD}")] if prefix else []) + fixed

    def start(self, stamp_ns: int) -> None:
        """Publish the fixed transforms, valid from ``stamp_ns`` on, ns."""
        stamp = _TYPE["builtin_interfaces/msg/Time"](sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
        origin = _TYPE["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=0.0)
        level = _TYPE["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0)
        self._fixed.publish(_message(_transform(stamp, *pair, origin, level) for pair in self._pairs))

    def follow(self, odometry: bytes) -> None:
        """Publish the place of the robot, from its serialized odometry."""
        message: Any = _STORE.deserialize_cdr(odometry, "nav_msgs/msg/Odometry")
        pose, header = message.pose.pose, message.header
        place = _TYPE["geometry_msgs/msg/Vector3"](x=pose.position.x, y=pose.position.y, z=pose.position.z)
        moving = _transform(header.stamp, header.frame_id, message.child_frame_id, place, pose.orientation)
        self._moving.publish(_message([moving]))

    def close(self) -> None:
        """Leave the graph."""
        self._moving.close()
        self._fixed.close()


def _transform(stamp: Any, parent: str, child: str, translation: Any, rotation: Any) -> Any:
    return _TYPE["geometry_msgs/msg/TransformStamped"](
        header=_TYPE["std_msgs/msg/Header"](stamp=stamp, frame_id=parent),
        child_frame_id=child,
        transform=_TYPE["geometry_msgs/msg/Transform"](translation=translation, rotation=rotation),
    )


def _message(transforms: Iterable[Any]) -> bytes:
    return bytes(_STORE.serialize_cdr(_TYPE[TF_TYPE](transforms=list(transforms)), TF_TYPE))
