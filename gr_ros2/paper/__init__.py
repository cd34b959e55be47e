"""The paper's blocks, ROS Source and ROS Sink, and the engines of version 0, which they speak.

Invariant: GNU Radio is imported when a block is asked for; the engines are sans-IO, as those of ``link`` are.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gr_ros2.paper.blocks import RosSink, RosSource

__all__ = ["RosSink", "RosSource"]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module("gr_ros2.paper.blocks"), name)
