"""Drives that tests and benchmarks replay: one of our simulator, which is always there, and a recorded one where it is.

``tools/record-drive`` writes ours. The recorded one, a Husky outdoors, is no part of this repository.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import pytest

_DATA = Path(__file__).parent / "data"
_SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"


@dataclass(frozen=True)
class Drive:
    """A bag of one robot, ``/robot_1``; every message has a header, and its odometry comes at 10 Hz.

    :param path: of the bag
    :param topics: type by name, without the namespace
    """

    path: Path
    topics: Mapping[str, str]

    @property
    def names(self) -> tuple[str, ...]:
        """The topics as they are on the graph."""
        return tuple(f"/robot_1/{name}" for name in self.topics)

    def write_registry(self, path: Path) -> Path:
        """A registry of its topics."""
        path.write_text("".join(f"{name},{kind}\n" for name, kind in self.topics.items()), encoding="utf-8")
        return path


_BOTH = {"odom": "nav_msgs/msg/Odometry", "imu": "sensor_msgs/msg/Imu"}
SIMULATED = Drive(_DATA / "simulated_drive", {**_BOTH, "scan": "sensor_msgs/msg/LaserScan"})
HUSKY = Drive(_SHARED / "husky_outdoor", {**_BOTH, "fix": "sensor_msgs/msg/NavSatFix"})
DRIVES = [SIMULATED, *([HUSKY] if HUSKY.path.is_dir() else [])]
"""Those that are on this machine."""

every_drive = pytest.mark.parametrize("drive", DRIVES, ids=lambda drive: drive.path.name)
