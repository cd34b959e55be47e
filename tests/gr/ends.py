"""One robot's end of a link without a radio, for tests of its blocks."""

from __future__ import annotations

from typing import Any

from gr_ros2.gr import RosLink
from gr_ros2.gr.factory import Start
from gr_ros2.settings.robot import robot_from

OF_BLOCKS = ("air", "loops_back", "middleware", "observer", "clock", "backpressure", "registry")


def link(**values: Any) -> RosLink:
    """A ROS Link from settings in one list, whose starts are not counted."""
    blocks = {name: values.pop(name) for name in OF_BLOCKS if name in values}
    if isinstance(blocks.get("registry"), str):
        values["registry"] = blocks.pop("registry")
    return RosLink(robot_from(**values), start=Start(), **blocks)
