"""Helpers around rclpy: a setting that rcl reads from the environment, names on its graph, and its errors.

Invariant: nothing here imports rclpy.
"""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Iterator
from typing import Any

from gr_ros2.core.errors import MiddlewareError
from gr_ros2.settings.fields import AUTO, Auto

_environment = threading.Lock()


@contextlib.contextmanager
def ros_localhost_only(localhost_only: bool | Auto) -> Iterator[None]:
    """Set ROS_LOCALHOST_ONLY: rcl reads it when a context is initialised, and offers no other interface for it."""
    if localhost_only == AUTO:
        yield
        return
    with _environment:
        before = os.environ.get("ROS_LOCALHOST_ONLY")
        os.environ["ROS_LOCALHOST_ONLY"] = str(int(localhost_only))
        try:
            yield
        finally:
            if before is None:
                del os.environ["ROS_LOCALHOST_ONLY"]
            else:
                os.environ["ROS_LOCALHOST_ONLY"] = before


def node_of(endpoint: Any) -> str:
    """The absolute name of the node of an endpoint (an rclpy TopicEndpointInfo), '' where it is not known yet.

    The RMW finds an endpoint before it is told the node. Until then it fills in names without a slash
    (``_NODE_NAMESPACE_UNKNOWN_``).
    """
    namespace, name = endpoint.node_namespace, endpoint.node_name
    return f"{namespace.rstrip('/')}/{name}" if namespace.startswith("/") else ""


class translated(contextlib.AbstractContextManager[None]):
    """Raises RuntimeErrors of rclpy (RCLError, InvalidHandle) as MiddlewareError."""

    def __init__(self, what: str) -> None:
        self._what = what

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if isinstance(error, RuntimeError) and not isinstance(error, MiddlewareError):
            raise MiddlewareError(f"{self._what}: {error}") from error
