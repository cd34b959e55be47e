"""ROS graphs behind one interface: choose a back-end by name, move serialized messages through it."""

from __future__ import annotations

from gr_ros2.middleware.base import Middleware, Publisher, Qos, Subscription, TopicInfo
from gr_ros2.middleware.graph_backends import MIDDLEWARE, GraphBackend, join, join_graph, joined, meet

__all__ = [
    "MIDDLEWARE",
    "GraphBackend",
    "Middleware",
    "Publisher",
    "Qos",
    "Subscription",
    "TopicInfo",
    "join",
    "join_graph",
    "joined",
    "meet",
]
