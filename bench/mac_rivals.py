"""What slots are compared with: CSMA and AIS's SOTDMA (ITU-R M.1371) in one cell, each as good as it can be made.

Robots send messages of one packet. Packets that overlap are lost for all. What is known of the air can change what is
sent ``LATENCY_S`` later.
"""

from __future__ import annotations

import heapq
import math
import random
from collections.abc import Callable
from typing import Any

AIRTIME_S, LATENCY_S, PERIOD_S, GUARD_S = 1 / 75, 0.010, 0.1, 0.001


class Cell:
    """Robots that all hear each other.

    :ivar delivered: packets after ``t0`` that nobody disturbed
    """

    def __init__(self, robots: int, seed: int, *, t0: float = 20.0, t1: float = 80.0) -> None:
        self.robots, self.t0, self.t1 = robots, t0, t1
        self.rng = random.Random(seed)
        self.now, self.delivered = 0.0, 0
        self._events: list[tuple[float, int, Callable[..., None], tuple[Any, ...]]] = []
        self._count = 0
        self.air: list[list[Any]] = []
        """Packets on the air: robot, end, whether it is undisturbed so far, what it says."""
        self._newest = [-1] * robots

    def at(self, when: float, call: Callable[..., None], *values: Any) -> None:
        self._count += 1
        heapq.heappush(self._events, (when, self._count, call, values))

    def send(self, robot: int, says: Any = None) -> None:
        packet = [robot, self.now + AIRTIME_S, True, says, math.floor((self.now - LATENCY_S) / PERIOD_S)]
        for other in self.air:
            packet[2] = other[2] = False
        self.air.append(packet)
        self.at(packet[1], self._over, packet)
        self.begun()

    def _over(self, packet: list[Any]) -> None:
        self.air.remove(packet)
        robot, _, arrived, _, message = packet
        if arrived and message > self._newest[robot]:
            self._newest[robot] = message
            self.delivered += self.now >= self.t0
        self.ended(packet)

    def begun(self) -> None:
        """A packet begins."""

    def ended(self, packet: list[Any]) -> None:
        """A packet is over."""

    def rate(self) -> float:
        """Messages/s that arrive."""
        while self._events and self._events[0][0] <= self.t1:
            self.now, _, call, values = heapq.heappop(self._events)
            call(*values)
        return self.delivered / (self.t1 - self.t0)


class Csma(Cell):
    """Back-off counts down while the air is idle; a decision starts a packet ``LATENCY_S`` later.

    :param window: of the back-off, in latencies per robot
    """

    def __init__(self, robots: int, seed: int, window: float) -> None:
        super().__init__(robots, seed)
        self._window = window
        self._left: dict[int, float] = {}
        self._since: dict[int, float] = {}
        self._turn = [0] * robots
        for robot in range(robots):
            self.at(self.rng.uniform(0, PERIOD_S), self._message, robot)

    def _message(self, robot: int) -> None:
        self.at(self.now + PERIOD_S, self._message, robot)
        if robot not in self._left and all(packet[0] != robot for packet in self.air):
            self._left[robot] = self.rng.random() * self._window * self.robots * LATENCY_S
            self._since[robot] = self.now
            self._count_down(robot)

    def _count_down(self, robot: int) -> None:
        self._turn[robot] += 1
        if not self.air:
            self._since[robot] = self.now
            self.at(self.now + self._left[robot], self._decide, robot, self._turn[robot])

    def _decide(self, robot: int, turn: int) -> None:
        if turn == self._turn[robot] and robot in self._left:
            del self._left[robot]
            self.at(self.now + LATENCY_S, self.send, robot)

    def begun(self) -> None:
        if len(self.air) == 1:
            for robot in self._left:
                self._left[robot] = max(0.0, self._left[robot] - (self.now - self._since[robot]))
                self._turn[robot] += 1

    def ended(self, packet: list[Any]) -> None:  # noqa: ARG002
        if not self.air:
            for robot in self._left:
                self._count_down(robot)


class Sotdma(Cell):
    """Frames of 2 s; a robot keeps each of its slots for 3 to 7 frames and then says which one it takes instead."""

    FILL = 0.9
    """Share of the slots that robots take together."""

    def __init__(self, robots: int, seed: int) -> None:
        super().__init__(robots, seed)
        self._slot = AIRTIME_S + GUARD_S
        self._frame = round(2.0 / self._slot)
        self._each = max(1, min(round(2.0 / PERIOD_S), int(self.FILL * self._frame / robots)))
        self._taken: dict[int, tuple[int, int]] = {}
        self._mine: list[dict[int, int]] = [{} for _ in range(robots)]
        for robot in range(robots):
            self.at(2.0 + self.rng.uniform(0, 2.0 * robots / 5), self._enter, robot)

    def _choose(self, robot: int, part: int, frame: int) -> int | None:
        first, last = part * self._frame // self._each, (part + 1) * self._frame // self._each
        free = [
            slot
            for slot in range(first, last)
            if self._taken.get(slot, (robot, frame))[1] < frame or self._taken.get(slot, (robot, 0))[0] == robot
        ]
        free = [slot for slot in free if slot not in self._mine[robot]]
        return self.rng.choice(free) if free else None

    def _enter(self, robot: int) -> None:
        frame = int(self.now / self._slot) // self._frame + 1
        for part in range(self._each):
            slot = self._choose(robot, part, frame)
            if slot is not None:
                self._take(robot, slot, frame)

    def _take(self, robot: int, slot: int, frame: int) -> None:
        self._mine[robot][slot] = self.rng.randint(3, 7)
        self.at((frame * self._frame + slot) * self._slot, self._use, robot, slot, frame)

    def _use(self, robot: int, slot: int, frame: int) -> None:
        left = self._mine[robot].pop(slot) - 1
        instead = None
        if left > 0:
            self._mine[robot][slot] = left
            self.at(((frame + 1) * self._frame + slot) * self._slot, self._use, robot, slot, frame + 1)
        else:
            part = min(self._each - 1, slot * self._each // self._frame)
            instead = self._choose(robot, part, frame + 1)
            self._take(robot, slot if instead is None else instead, frame + 1)
        self.send(robot, (slot, frame + left, instead, frame + 2))

    def ended(self, packet: list[Any]) -> None:
        robot, _, arrived, (slot, until, instead, then), _ = packet
        if arrived:
            self._taken[slot] = robot, until
            if instead is not None:
                self._taken[instead] = robot, then
