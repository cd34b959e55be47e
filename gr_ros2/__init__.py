"""gr-ros2: native ROS 2 topics over any GNU Radio physical layer, without IP."""

from __future__ import annotations

import os

__version__ = "0.1.0"

# Otherwise GNU Radio starts ten threads for its ControlPort as it is loaded, whether that is used or not.
os.environ.setdefault("GR_CONF_THRIFT_NTHREADS", "1")
