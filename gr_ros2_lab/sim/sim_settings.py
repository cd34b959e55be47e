"""Settings of the simulator.

Invariant: the same settings give the same bytes. The rate and noise of one topic do not change the bytes of another.
"""

from __future__ import annotations

from typing import Annotated

from pydantic import ConfigDict, Field, model_validator
from pydantic.dataclasses import dataclass

from gr_ros2.settings.config import Seeded

Rate = Annotated[float, Field(gt=0, le=10_000, allow_inf_nan=False)]
Noise = Annotated[float, Field(ge=0, le=10, allow_inf_nan=False)]


@dataclass(frozen=True, kw_only=True, config=ConfigDict(extra="forbid"))
class SimSettings(Seeded):
    """Robots, world, rates and noise."""

    robots: Annotated[int, Field(ge=1, le=255)] = 2
    """number of robots; they are called robot_1, robot_2, ..."""
    size_m: Annotated[float, Field(ge=10, le=100)] = 20.0
    """side of the square room, m"""
    obstacles: Annotated[int, Field(ge=0, le=100)] = 12
    """boxes and pillars in it; fewer where the room has no place for all"""
    max_speed: Annotated[float, Field(ge=0.1, le=2)] = 1.0
    """m/s"""
    scan_rate: Rate = 5.0
    """laser scans, Hz"""
    odom_rate: Rate = 30.0
    """odometry, Hz"""
    imu_rate: Rate = 50.0
    """Hz"""
    map_rate: Annotated[float, Field(ge=0, le=100, allow_inf_nan=False)] = 0.0
    """maps, Hz; 0 = once at the start"""
    rtcm_rate: Annotated[float, Field(ge=0, le=100, allow_inf_nan=False)] = 0.0
    """RTK corrections of a base station, Hz; 0 = there are none"""
    camera_rate: Annotated[float, Field(ge=0, le=100, allow_inf_nan=False)] = 0.0
    """pictures of 320 × 240, Hz; 0 = there is no camera"""
    beams: Annotated[int, Field(ge=1, le=10_000)] = 360
    """of a laser scan, over the full turn"""
    map_cells: Annotated[int, Field(ge=10, le=2000)] = 100
    """cells along each side of the map"""
    odom_noise: tuple[Noise, Noise] = (0.02, 0.01)
    """of the measured forward speed, m/s, and turn rate, rad/s; the odometry pose integrates both, so it drifts"""
    start_time_s: Annotated[float, Field(ge=0, le=2**31 - 1)] = 0.0
    """s, what the stamps begin at"""
    prefix_frames: bool = False
    """frame ids carry the robot's name (robot_1/odom), for robots that share one graph"""
    transforms: bool = False
    """robots publish ``/tf`` and ``/tf_static`` too, in real time, which no link carries"""

    def frame_prefix(self, robot_id: int) -> str:
        """The prefix of the names of a robot's frames; '' if they have none."""
        return f"robot_{robot_id}/" if self.prefix_frames else ""

    @model_validator(mode="after")
    def _room(self) -> SimSettings:
        if self.robots > 2 and self.size_m < 15:
            raise ValueError(f"size_m = {self.size_m}: {self.robots} robots need a room of 15 m or more")
        return self
