"""The robots together: their true motion, and the messages of all of them in time order.

Invariants: no clock, no thread, no global generator. Time is simulated, with t = 0 at the start. The same settings give
the same bytes, also in a second call of ``messages``. A topic at ``rate`` sends exactly rate * duration messages if
that is a whole number. Each topic of each robot has its own phase, as real sensors have.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from gr_ros2.core.arrays import Floats
from gr_ros2.core.errors import ConfigError
from gr_ros2_lab.sim.driver import Driver
from gr_ros2_lab.sim.motion import RADIUS, TICK, State, places_and_velocities
from gr_ros2_lab.sim.roadmap import Roadmap
from gr_ros2_lab.sim.sensors import ALL_TYPES, ALWAYS_HZ, CAMERA, TYPES, Sensors
from gr_ros2_lab.sim.sim_settings import SimSettings
from gr_ros2_lab.sim.world import World

_START_GAP_M = 3.0
_DRIVEN_S = 30.0
"""s that robots drive ahead of a run at most."""


@dataclass(frozen=True, slots=True)
class SimMessage:
    """One message of one robot.

    :param t: simulated time, s
    :param topic: absolute name, for instance ``/robot_1/odom``
    :param type_name: for instance ``nav_msgs/msg/Odometry``
    :param payload: serialized message with its encapsulation header
    """

    t: float
    robot_id: int
    topic: str
    type_name: str
    payload: bytes


@lru_cache(maxsize=8)
def _room(seed: int, size_m: float, obstacles: int, robots: int) -> tuple[World, Roadmap, Sequence[int]]:
    """The world, its ways, and where the robots start, at a distance from each other. Nothing in it ever changes, and
    a run asks several times: for the load, for each direction, for what the channel does."""
    rng = np.random.default_rng([seed, 0])
    world = World(size_m, obstacles, rng)
    roadmap = Roadmap(world, RADIUS + 0.25, rng, robots)
    places: list[int] = []
    for node in rng.permutation(roadmap.reachable).tolist():
        away = [math.hypot(*(roadmap.nodes[node] - roadmap.nodes[other])) for other in places]
        if min(away, default=math.inf) >= _START_GAP_M:
            places.append(node)
        if len(places) == robots:
            return world, roadmap, places
    raise ConfigError(f"robots = {robots}: no room to start in size_m = {size_m:g}; use fewer robots or a larger room")


class Fleet:
    """Robots 1, 2, ... driving in one world.

    :ivar world: the world in which they drive
    :ivar robot_ids: 1, 2, ...
    """

    def __init__(self, settings: SimSettings | None = None) -> None:
        self.settings = settings = settings or SimSettings()
        self.robot_ids = tuple(range(1, settings.robots + 1))
        self.world, roadmap, places = _room(settings.seed, settings.size_m, settings.obstacles, settings.robots)
        self._drivers = [
            Driver(self.world, roadmap, node, settings.max_speed, np.random.default_rng([settings.seed, 1, robot_id]))
            for robot_id, node in zip(self.robot_ids, places, strict=True)
        ]
        self._log: list[list[State]] = [[] for _ in self._drivers]

    @staticmethod
    @lru_cache(maxsize=2)
    def of(settings: SimSettings) -> Fleet:
        """The fleet of these settings, which drives only once for all who ask where it is."""
        return Fleet(settings)

    def namespace(self, robot_id: int) -> str:
        """Where its topics are: ``/robot_1``."""
        return f"/robot_{robot_id}"

    def topics(self) -> dict[str, str]:
        """Topic name without namespace -> type, in the order of the paper's table 4, then what is optional."""
        return {name: kind for name, kind in ALL_TYPES.items() if name in TYPES or self._rate(name)}

    def rates(self) -> dict[str, float]:
        """Topic name without namespace -> Hz; 0 = once."""
        return {name: self._rate(name) for name in self.topics()}

    def _rate(self, name: str) -> float:
        return ALWAYS_HZ[name] if name in ALWAYS_HZ else getattr(self.settings, f"{name}_rate")

    def state(self, robot_id: int, t: float) -> State:
        """The true place and motion of a robot at simulated time ``t`` >= 0."""
        tick = int(t / TICK)
        while len(self._log[0]) <= tick:
            for driver, log in zip(self._drivers, self._log, strict=True):
                log.append(driver.drive([other for other in self._drivers if other is not driver]))
        return self._log[self.robot_ids.index(robot_id)][tick].after(min(TICK, max(0.0, t - tick * TICK)))

    def drive_ahead(self, duration_s: float) -> None:
        """Drive now for up to so many s of simulated time; see :class:`gr_ros2_lab.sim.publisher.Robots`."""
        self.state(1, min(duration_s, _DRIVEN_S))

    def at(self, now: float, robot_ids: Sequence[int]) -> tuple[Floats, Floats]:
        """Places in m and velocities in m/s of robots at simulated time ``now``, each of shape (robots, 2)."""
        return places_and_velocities(self.state(robot_id, now) for robot_id in robot_ids)

    def messages(
        self, duration_s: float, start_time_s: float | None = None, topics: Collection[str] | None = None
    ) -> Iterator[SimMessage]:
        """All messages with 0 <= t < duration_s, in time order, each made when it is asked for.

        :param duration_s: s, may be infinite
        :param start_time_s: stamps are this + t; None takes ``settings.start_time_s``
        :param topics: absolute names of the topics to return, None = all. The choice does not change their bytes
        """
        start_ns = round((self.settings.start_time_s if start_time_s is None else start_time_s) * 1e9)
        sensors = {i: Sensors(self.settings, self.world, i, self.state(i, 0.0), start_ns) for i in self.robot_ids}
        schedule = [event for i in self.robot_ids for event in self._first_events(i)]
        heapq.heapify(schedule)
        while schedule and schedule[0][0] < duration_s:
            t, order, robot_id, count, topic, rate, phase = schedule[0]
            if rate:
                following = (count + 1 + phase) / rate
                heapq.heapreplace(schedule, (following, order, robot_id, count + 1, topic, rate, phase))
            else:
                heapq.heappop(schedule)
            name = f"{self.namespace(robot_id)}/{topic}"
            if topics is not None and name not in topics:
                continue
            state = self.state(robot_id, t)
            if topic == "cmd_vel":  # the command of this period is the motion at its end
                tick = int(t / TICK)
                state = self._log[robot_id - 1][tick].after(TICK)
            others = [self.state(i, t) for i in self.robot_ids if i != robot_id] if topic in ("scan", CAMERA) else ()
            payload = sensors[robot_id].read(topic, t, state, others)
            yield SimMessage(t, robot_id, name, ALL_TYPES[topic], payload)

    def _first_events(self, robot_id: int) -> Iterator[tuple[float, int, int, int, str, float, float]]:
        phases = np.random.default_rng([self.settings.seed, 3, robot_id]).uniform(size=len(ALL_TYPES)).tolist()
        for order, ((topic, rate), phase) in enumerate(zip(self.rates().items(), phases, strict=False)):
            offset = 0.0 if topic == "map" else phase
            yield (offset / rate if rate else 0.0, order, robot_id, 0, topic, rate, offset)
