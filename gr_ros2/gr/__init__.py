"""GNU Radio blocks: ROS topics to PDUs and back, on message port `pdus`.

Invariant: GNU Radio is imported when a block is asked for, so that the parts of this package that need none, such as
the making of an end's engine, work without it.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gr_ros2.gr.ros_link import RosLink
    from gr_ros2.phy.airtime import AirtimeGate

__all__ = ["AirtimeGate", "RosLink"]

_BLOCKS = {
    "AirtimeGate": "gr_ros2.phy.airtime",
    "RosLink": "gr_ros2.gr.ros_link",
}


def __getattr__(name: str) -> Any:
    if name not in _BLOCKS:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_BLOCKS[name]), name)
