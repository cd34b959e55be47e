"""gr-ros2: native ROS 2 topics over any GNU Radio physical layer, without IP."""

from __future__ import annotations

__version__ = "0.1.0"
