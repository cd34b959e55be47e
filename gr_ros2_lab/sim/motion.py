"""How a differential-drive robot moves within one control period.

Invariant: speed and turn rate change linearly within a period of ``TICK`` seconds. ``ACCELERATION`` and
``TURN_ACCELERATION`` limit the change. A pose between two ticks is the integral of this motion, so paths have no
corners.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from gr_ros2.core.arrays import Floats

TICK = 0.1
"""Time between two commands, s."""
RADIUS = 0.35
"""Radius of a robot's round footprint, m."""
ACCELERATION = 1.0
"""m/s^2, speeding up and braking."""
MAX_TURN = 1.5
"""rad/s."""
TURN_ACCELERATION = 4.0
"""rad/s^2."""

# Gauss-Legendre over one period: with three nodes the error of a period's displacement is below 1e-8 m.
_NODES = tuple(0.5 + 0.5 * node for node in (-math.sqrt(0.6), 0.0, math.sqrt(0.6)))
_WEIGHTS = (5 / 18, 8 / 18, 5 / 18)


class State(NamedTuple):
    """A robot at an instant: m, rad, m/s, rad/s, and the accelerations that hold until the next tick."""

    x: float
    y: float
    heading: float
    speed: float
    turn: float
    acceleration: float = 0.0
    turn_acceleration: float = 0.0

    def after(self, dt: float) -> State:
        """The same robot ``dt`` seconds later, 0 <= dt <= TICK."""
        x, y = self.x, self.y
        for node, weight in zip(_NODES, _WEIGHTS, strict=True):
            t = node * dt
            heading = self.heading + (self.turn + 0.5 * self.turn_acceleration * t) * t
            length = weight * dt * (self.speed + self.acceleration * t)
            x += length * math.cos(heading)
            y += length * math.sin(heading)
        return State(
            x,
            y,
            self.heading + (self.turn + 0.5 * self.turn_acceleration * dt) * dt,
            self.speed + self.acceleration * dt,
            self.turn + self.turn_acceleration * dt,
            self.acceleration,
            self.turn_acceleration,
        )

    def towards(self, speed: float, turn: float) -> State:
        """The same robot with the accelerations that reach a speed and turn rate at the next tick."""
        return self._replace(acceleration=(speed - self.speed) / TICK, turn_acceleration=(turn - self.turn) / TICK)

    def reach(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Least and greatest speed, and least and greatest turn rate, that the robot can have at the next tick."""
        more, turn = ACCELERATION * TICK, TURN_ACCELERATION * TICK
        return (self.speed - more, self.speed + more), (self.turn - turn, self.turn + turn)

    def braking(self) -> tuple[float, float]:
        """Speed and turn rate at the next tick when the robot brakes as hard as it can."""
        turn = math.copysign(max(0.0, abs(self.turn) - TURN_ACCELERATION * TICK), self.turn)
        return max(0.0, self.speed - ACCELERATION * TICK), turn


def places_and_velocities(states: Iterable[State]) -> tuple[Floats, Floats]:
    """Places in m and velocities in m/s of robots, each of shape (robots, 2)."""
    x, y, heading, speed = np.array([state[:4] for state in states]).T
    return np.stack([x, y], 1), np.stack([speed * np.cos(heading), speed * np.sin(heading)], 1)


def stopping_paths(state: State, speeds: Floats, turns: Floats, longest: int) -> Floats:
    """Where the robot is at each tick if it takes a command for one period and brakes from then on.

    :param speeds: commanded speeds, shape (n,)
    :param turns: commanded turn rates, shape (n,)
    :param longest: number of ticks in which it stops from any speed
    :returns: points of shape (n, 2 + longest, 2); the first one is where the robot is now
    """
    ticks = np.arange(longest + 1)
    speed = np.maximum(0.0, speeds[:, None] - ACCELERATION * TICK * ticks)
    slowed = np.maximum(0.0, np.abs(turns)[:, None] - TURN_ACCELERATION * TICK * ticks)
    turn = np.copysign(slowed, turns[:, None])
    speed = np.concatenate([np.full((len(speeds), 1), state.speed), speed], axis=1)
    turn = np.concatenate([np.full((len(turns), 1), state.turn), turn], axis=1)
    heading = np.zeros_like(turn)
    heading[:, 1:] = np.cumsum((turn[:, 1:] + turn[:, :-1]) * (TICK / 2), axis=1)
    heading += state.heading
    points = np.empty((*speed.shape, 2))
    points[:, 0] = state.x, state.y
    step_x, step_y = np.zeros_like(speed[:, 1:]), np.zeros_like(speed[:, 1:])
    gain, turn_gain = np.diff(speed, axis=1), np.diff(turn, axis=1)
    for node, weight in zip(_NODES, _WEIGHTS, strict=True):
        angle = heading[:, :-1] + (turn[:, :-1] + (0.5 * node) * turn_gain) * (node * TICK)
        length = (weight * TICK) * (speed[:, :-1] + node * gain)
        step_x += length * np.cos(angle)
        step_y += length * np.sin(angle)
    points[:, 1:, 0] = state.x + np.cumsum(step_x, axis=1)
    points[:, 1:, 1] = state.y + np.cumsum(step_y, axis=1)
    return points
