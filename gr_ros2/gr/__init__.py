"""GNU Radio blocks: ROS topics to PDUs and back, on message port `pdus`."""

from __future__ import annotations

from gr_ros2.gr.ros_link import RosLink
from gr_ros2.gr.sink import RosSink
from gr_ros2.gr.source import RosSource
from gr_ros2.phy.airtime import AirtimeGate

__all__ = ["AirtimeGate", "RosLink", "RosSink", "RosSource"]
