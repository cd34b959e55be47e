"""Drives one robot from place to place: pure pursuit along the roadmap, with a safety check that has the last word.

Invariant: a robot takes a command only if it could brake at once after it and stop without touching anything. The
points it would pass while braking are its ``reserved`` path. Robots decide one after the other and stay clear of the
reserved paths of the others. So braking along the reserved path is always a safe choice. No robot ever touches a wall,
an obstacle or another robot, whatever the route.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from gr_ros2.core.arrays import Floats
from gr_ros2_lab.sim.motion import ACCELERATION, MAX_TURN, RADIUS, TICK, State, stopping_paths
from gr_ros2_lab.sim.roadmap import Roadmap
from gr_ros2_lab.sim.world import World

_LOOKAHEAD_M = 1.2
_ARRIVED_M = 0.5
_TRIP_M = 7.0
_PATIENCE = 15
"""Ticks without motion before the driver retreats and chooses another route."""
_RETREAT = 25
"""Ticks for which it then moves away from the nearest things."""
_COMFORT_M = 1.0
"""Gap to another robot that the driver prefers, beyond the gap that safety requires."""
_COMFORT_WALL_M = 0.15
"""The same for walls and obstacles."""


class Driver:
    """Decides the commands of one robot.

    :param node: place of the roadmap where it starts
    :param rng: generator of destinations and of small irregularities in its commands
    """

    def __init__(self, world: World, roadmap: Roadmap, node: int, max_speed: float, rng: np.random.Generator) -> None:
        self._world, self._roadmap, self._rng = world, roadmap, rng
        self._max_speed = max_speed
        self._brake_ticks = math.ceil(max_speed / (ACCELERATION * TICK))
        # Paths are checked only at points, at most max_speed * TICK apart. Between two points the clearance may be
        # smaller by half of that.
        self._wall_gap = RADIUS + max_speed * TICK / 2 + 0.03
        self._robot_gap = 2 * RADIUS + max_speed * TICK + 0.05
        self._stuck = self._retreat = 0
        self._route: list[int] = [node]
        x, y = roadmap.nodes[node]
        self.state = State(float(x), float(y), float(rng.uniform(-math.pi, math.pi)), 0.0, 0.0)
        """State at the latest tick."""
        self.reserved: Floats = np.array([[x, y]], dtype=np.float64)
        """Points (n, 2) the robot would pass if it braked now."""
        self.box = _box(self.reserved)
        """The least and greatest x and y of those."""

    def drive(self, others: Sequence[Driver]) -> State:
        """Choose the command for the next period.

        :returns: the state now, with the accelerations of that period; ``state`` is then one period later
        """
        target = self._target(others)
        speeds, turns = self._commands()
        paths = stopping_paths(self.state, speeds, turns, self._brake_ticks)
        cost = self._cost(target, speeds, turns)
        gap = self._world.clearance(paths, self._wall_gap + _COMFORT_WALL_M).min(axis=1) - self._wall_gap
        safe = gap >= 0
        cost = cost + np.maximum(0.0, 1.0 - gap / _COMFORT_WALL_M)
        left, low, right, high = _box(paths, self._robot_gap + _COMFORT_M)
        for other in others:
            from_x, from_y, to_x, to_y = other.box
            if from_x > right or from_y > high or to_x < left or to_y < low:
                continue  # its path is so far from all of these that it changes neither safety nor cost
            dx = paths[:, :, 0, None] - other.reserved[:, 0]
            dy = paths[:, :, 1, None] - other.reserved[:, 1]
            gap = np.sqrt((dx * dx + dy * dy).reshape(len(paths), -1).min(axis=1)) - self._robot_gap
            safe &= gap >= 0
            cost = cost + np.maximum(0.0, 1.0 - gap / _COMFORT_M)
        if safe.any():
            best = int(np.where(safe, cost, np.inf).argmin())
            now = self.state.towards(float(speeds[best]), float(turns[best]))
            self.reserved = paths[best]
            self.box = _box(self.reserved)
        else:
            # Follow the rest of the path reserved before. It has been clear since the tick that chose it.
            now = self.state.towards(*self.state.braking())
        self.state = now.after(TICK)
        self._stuck = self._stuck + 1 if self.state.speed < 0.05 else 0
        return now

    def _commands(self) -> tuple[Floats, Floats]:
        """Speeds and turn rates that can be reached within one period, slightly irregular, full braking included."""
        state, ((slowest, fastest), (least, most)) = self.state, self.state.reach()
        low, high = max(0.0, slowest), min(self._max_speed, fastest)
        left, right = max(-MAX_TURN, least), min(MAX_TURN, most)
        speed, turn = np.meshgrid(np.linspace(low, high, 5), np.linspace(left, right, 11))
        speeds = speed.ravel() + self._rng.normal(0.0, 0.01, speed.size)
        turns = turn.ravel() + self._rng.normal(0.0, 0.02, turn.size)
        brake = state.braking()
        return (
            np.append(np.clip(speeds, low, high), brake[0]),
            np.append(np.clip(turns, left, right), brake[1]),
        )

    def _cost(self, target: Floats, speeds: Floats, turns: Floats) -> Floats:
        """Distance of each command from pure pursuit: turn to the target, slow down in sharp turns."""
        state = self.state
        bearing = math.atan2(target[1] - state.y, target[0] - state.x) - state.heading
        bearing = math.atan2(math.sin(bearing), math.cos(bearing))
        wanted_turn = max(-MAX_TURN, min(MAX_TURN, 1.8 * bearing))
        wanted_speed = self._max_speed * max(0.0, math.cos(bearing)) ** 2
        return ((speeds - wanted_speed) / self._max_speed) ** 2 + ((turns - wanted_turn) / MAX_TURN) ** 2

    def _target(self, others: Sequence[Driver]) -> Floats:
        """The point to steer to: ahead on the line to the farthest place of the route that is in sight."""
        here = np.array([self.state.x, self.state.y])
        nodes = self._roadmap.nodes
        if self._stuck > _PATIENCE:
            self._stuck, self._retreat = 0, _RETREAT
        if self._retreat:
            self._retreat -= 1
            if not self._retreat:
                self._new_route(self._roadmap.nearest(here), others)
            return here + self._away(here, others)
        if len(self._route) == 1 and math.hypot(*(nodes[self._route[0]] - here)) < _ARRIVED_M:
            self._new_route(self._route[0], others)
        while len(self._route) > 1 and self._world.clear_line(
            here, nodes[self._route[1]], self._roadmap.clearance * 0.85
        ):
            del self._route[0]
        way = nodes[self._route[0]] - here
        length = math.hypot(*way)
        if len(self._route) > 1 and length < _ARRIVED_M:
            del self._route[0]
        return np.asarray(here + way * min(1.0, _LOOKAHEAD_M / max(length, 1e-9)))

    def _away(self, here: Floats, others: Sequence[Driver]) -> Floats:
        """A vector of one metre away from things that are near. Nearer things count more."""
        probes = here + 0.01 * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
        middle, right, left, up, down = self._world.clearance(probes).tolist()
        away = np.array([right - left, up - down]) / (0.02 * max(0.01, middle - RADIUS))
        for other in others:
            apart = here - other.reserved[0]
            distance = math.hypot(*apart)
            away += apart / (distance * max(0.01, distance - 2 * RADIUS))
        return np.asarray(away / max(1e-9, math.hypot(*away)))

    def _new_route(self, start: int, others: Sequence[Driver]) -> None:
        """Choose a route to a far place: of three, the one whose first step is farthest from the other robots."""
        far = self._roadmap.far_from(start, _TRIP_M)
        routes = [self._roadmap.route(start, int(goal)) for goal in self._rng.choice(far, 3)]

        def room(route: list[int]) -> float:
            first = self._roadmap.nodes[route[min(1, len(route) - 1)]]
            return min((math.hypot(*(first - other.reserved[0])) for other in others), default=0.0)

        self._route = max(routes, key=room)


def _box(points: Floats, margin: float = 0.0) -> tuple[float, float, float, float]:
    """The least x and y and the greatest x and y of points, and so many m around them."""
    (left, low), (right, high) = points.reshape(-1, 2).min(0).tolist(), points.reshape(-1, 2).max(0).tolist()
    return left - margin, low - margin, right + margin, high + margin
