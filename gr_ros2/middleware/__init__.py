"""ROS graphs behind one interface: choose a back-end by name, move serialized messages through it."""

from __future__ import annotations

from gr_ros2.backends import Backend, BackendTable
from gr_ros2.middleware.base import Middleware, Publisher, Qos, Subscription, TopicInfo

MIDDLEWARE = BackendTable(
    "middleware",
    {
        "dds": Backend(
            "gr_ros2.middleware.dds",
            "DdsMiddleware",
            "embedded DDS, no ROS install",
            "Cyclone DDS 11.0, which the installation of gr-ros2 brings",
        ),
        "rclpy": Backend(
            "gr_ros2.middleware.rclpy", "RclpyMiddleware", "a sourced ROS 2 (Humble or later)", "a sourced ROS 2 setup"
        ),
        "zenoh": Backend(
            "gr_ros2.middleware.zenoh",
            "ZenohMiddleware",
            "rmw_zenoh's conventions, experimental",
            "pip install eclipse-zenoh==1.10.2",
        ),
        "bag": Backend("gr_ros2.middleware.bag", "BagMiddleware", "a ROS 2 bag, MCAP or sqlite3"),
        "memory": Backend("gr_ros2.middleware.memory", "MemoryMiddleware", "one process, for tests"),
    },
)

__all__ = ["MIDDLEWARE", "Middleware", "Publisher", "Qos", "Subscription", "TopicInfo"]
