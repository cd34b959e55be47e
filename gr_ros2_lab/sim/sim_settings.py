"""Settings of the simulator.

Invariant: the same settings give the same bytes. The rate and noise of one topic do not change the bytes of another.
"""

from __future__ import annotations

from typing import Annotated

from pydantic import ConfigDict, Field, model_validator
from pydantic.dataclasses import dataclass

from gr_ros2.settings.config import Seed

Rate = Annotated[float, Field(gt=0, le=10_000, allow_inf_nan=False)]
Noise = Annotated[float, Field(ge=0, le=10, allow_inf_nan=False)]


@dataclass(frozen=True, kw_only=True, config=ConfigDict(extra="forbid"))
class SimSettings:
    """Robots, world, rates and noise.

    :param seed: of the world, the routes and all noise; in a scenario that of the scenario unless it is set
    :param robots: number of robots; they are called robot_1, robot_2, ...
    :param size_m: side of the square room, m
    :param obstacles: boxes and pillars in it; fewer where the room has no place for all
    :param max_speed: m/s
    :param scan_rate: laser scans, Hz
    :param odom_rate: odometry, Hz
    :param imu_rate: Hz
    :param cmd_vel_rate: velocity commands, Hz
    :param clock_rate: Hz
    :param map_rate: maps, Hz; 0 = once at the start
    :param rtcm_rate: RTK corrections of a base station, Hz; 0 = there are none
    :param camera_rate: pictures of 320 × 240, Hz; 0 = there is no camera
    :param beams: of a laser scan, over the full turn
    :param map_cells: cells along each side of the map
    :param odom_linear_noise: of the measured forward speed, m/s; the odometry pose integrates it, so it drifts
    :param odom_angular_noise: of the measured turn rate, rad/s; integrated likewise
    :param start_time_s: s, what the stamps begin at
    :param prefix_frames: frame ids carry the robot's name (robot_1/odom), for robots that share one graph
    :param transforms: robots that publish in real time publish ``/tf`` and ``/tf_static`` too, which no link carries
    """

    seed: Seed = 0
    robots: Annotated[int, Field(ge=1, le=255)] = 2
    size_m: Annotated[float, Field(ge=10, le=100)] = 20.0
    obstacles: Annotated[int, Field(ge=0, le=100)] = 12
    max_speed: Annotated[float, Field(ge=0.1, le=2)] = 1.0
    scan_rate: Rate = 5.0
    odom_rate: Rate = 30.0
    imu_rate: Rate = 50.0
    cmd_vel_rate: Rate = 10.0
    clock_rate: Rate = 10.0
    map_rate: Annotated[float, Field(ge=0, le=100, allow_inf_nan=False)] = 0.0
    rtcm_rate: Annotated[float, Field(ge=0, le=100, allow_inf_nan=False)] = 0.0
    camera_rate: Annotated[float, Field(ge=0, le=100, allow_inf_nan=False)] = 0.0
    beams: Annotated[int, Field(ge=1, le=10_000)] = 360
    map_cells: Annotated[int, Field(ge=10, le=2000)] = 100
    odom_linear_noise: Noise = 0.02
    odom_angular_noise: Noise = 0.01
    start_time_s: Annotated[float, Field(ge=0, le=2**31 - 1)] = 0.0
    prefix_frames: bool = False
    transforms: bool = False

    def frame_prefix(self, robot_id: int) -> str:
        """The prefix of the names of a robot's frames; '' if they have none."""
        return f"robot_{robot_id}/" if self.prefix_frames else ""

    @model_validator(mode="after")
    def _room(self) -> SimSettings:
        if self.robots > 2 and self.size_m < 15:
            raise ValueError(f"size_m = {self.size_m}: {self.robots} robots need a room of 15 m or more")
        return self
