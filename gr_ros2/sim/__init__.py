"""Simulated robots that publish the topics of the paper's table 4 while driving among obstacles.

Written here because the kept simulator library that came closest (ir-sim 2.12.0, two robots, 360 beams at 5 Hz,
steps of 20 ms, on the machine that runs this at 15 ms per simulated second, messages included) took 41 to 77 ms per
simulated second without any message, left its robots stuck or in contact with obstacles in five of six seeds
(4 to 15 m driven in 60 s), tries GUI back-ends even when headless, and brings scipy, shapely, imageio and loguru.

Invariant: sans-IO but for ``publisher``; time is simulated and every random number comes from a seeded generator.
"""

from __future__ import annotations

from gr_ros2.sim.fleet import Fleet, SimMessage
from gr_ros2.sim.publisher import SimPublisher
from gr_ros2.sim.settings import SimSettings
from gr_ros2.sim.world import World

__all__ = ["Fleet", "SimMessage", "SimPublisher", "SimSettings", "World"]
