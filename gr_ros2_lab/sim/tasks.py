"""What robots do together on what they hear of each other: tasks, and robots whose motion follows from them.

A task is where robots start, what each does next, and how well all of them do. Two are built in; another one is a class
of a user's module, ``task: module:Class``.

Invariants: no clock, thread or global generator; a robot knows its own place exactly, and of the others what its
link has delivered; messages are taken and made in the order of time; equal deliveries give equal motion.
"""

from __future__ import annotations

import importlib
import math
import random
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from gr_ros2.core.arrays import Floats
from gr_ros2.core.errors import ConfigError
from gr_ros2_lab.sim.motion import MAX_TURN, TICK, State, places_and_velocities
from gr_ros2_lab.sim.sensors import Sensors, read_odometry
from gr_ros2_lab.sim.sim_settings import SimSettings
from gr_ros2_lab.sim.world import World

Command = tuple[float, float]
"""Speed in m/s and turn rate in rad/s."""
COMMAND_HOLDS_S = 0.5
"""s after which a robot stops that gets no further commands (``cmd_vel_timeout`` of ros2_controllers)."""


class LastHeard(NamedTuple):
    """The newest odometry of another robot that has come out of the link.

    :param made_s: s, when it was measured
    :param state: place, heading, speed and turn rate then
    """

    made_s: float
    state: State

    def at(self, now: float) -> State:
        """Where that robot is now if it has kept its speed and turn rate."""
        state, left = self.state, max(0.0, now - self.made_s)
        while left > 0:
            state, left = state.after(min(left, TICK)), left - TICK
        return state


class Task:
    """What robots are to do. Subclasses say how.

    :param robots: how many there are; they are numbered from 0
    :param rng: for their places
    :cvar scripted: robots that the task drives itself, whoever controls the others
    :ivar over: whether all is done, which ends the run
    """

    scripted: Collection[int] = ()
    over = False

    def __init__(self, robots: int, rng: random.Random) -> None:
        self.robots, self.rng = robots, rng

    def start(self, number: int) -> State:
        """Where a robot starts."""
        raise NotImplementedError

    def command(self, number: int, now: float, own: State, heard: Mapping[int, LastHeard]) -> Command:
        """What a robot does from now on; asked ten times a second.

        :param heard: what its link has delivered, by robot
        """
        raise NotImplementedError

    def watch(self, now: float, states: Sequence[State]) -> None:
        """Take note of where all robots really are; called ten times a second."""

    def numbers(self) -> dict[str, float | None]:
        """How well it went, for the result."""
        return {}


class Formation(Task):
    """Robot 0 drives a winding way, now faster, now slower. The others keep their places around it, which do not turn
    with it: rows of three, 3 m apart.

    Result: ``formation_error_m``, the mean distance of the followers from their places beside the leader's true place,
    from ``SETTLED_S`` on.
    """

    SETTLED_S, GAP_M, MOST = 10.0, 3.0, 2.5
    scripted = (0,)

    def __init__(self, robots: int, rng: random.Random) -> None:
        super().__init__(robots, rng)
        self._phase = rng.uniform(0, 2 * math.pi)
        self._errors: list[float] = []

    def start(self, number: int) -> State:
        return State(*self._place(number, State(0.0, 0.0, 0.0, 0.0, 0.0)), 0.0, 0.0, 0.0)

    def command(self, number: int, now: float, own: State, heard: Mapping[int, LastHeard]) -> Command:
        if not number:
            return 1 + 0.5 * math.sin(0.7 * now), 0.8 * math.sin(0.45 * now + self._phase)
        if 0 not in heard:
            return 0.0, 0.0
        leader = heard[0].at(now)
        # The place has the leader's velocity; what is missing to it is made up for within a second.
        x, y = self._place(number, leader)
        ahead_x = leader.speed * math.cos(leader.heading) + x - own.x
        ahead_y = leader.speed * math.sin(leader.heading) + y - own.y
        return towards(own, ahead_x, ahead_y, self.MOST)

    def watch(self, now: float, states: Sequence[State]) -> None:
        if now >= self.SETTLED_S:
            for number, state in enumerate(states[1:], 1):
                x, y = self._place(number, states[0])
                self._errors.append(math.hypot(state.x - x, state.y - y))

    def numbers(self) -> dict[str, float | None]:
        return {"formation_error_m": sum(self._errors) / len(self._errors) if self._errors else None}

    def _place(self, number: int, leader: State) -> tuple[float, float]:
        row, column = divmod(number + 2, 3)
        return leader.x - self.GAP_M * row * bool(number), leader.y + self.GAP_M * (column - 1) * bool(number)


class Rendezvous(Task):
    """Robots that start anywhere in a square meet: each drives to the middle of all that it knows of, itself included.

    Result: ``time_to_meet_s``, when the last of them was within ``MEET_M`` of the middle of all, which ends the run;
    the duration where they have not met (``met`` is 0 then).
    """

    SIDE_M, MEET_M, SPEED = 60.0, 2.0, 2.0

    def __init__(self, robots: int, rng: random.Random) -> None:
        super().__init__(robots, rng)
        self._now = 0.0

    def start(self, number: int) -> State:  # noqa: ARG002
        place = self.rng.uniform(0, self.SIDE_M), self.rng.uniform(0, self.SIDE_M)
        return State(*place, self.rng.uniform(-math.pi, math.pi), 0.0, 0.0)

    def command(self, number: int, now: float, own: State, heard: Mapping[int, LastHeard]) -> Command:  # noqa: ARG002
        if not heard:
            return 0.0, 0.0
        places = [own, *(other.state for other in heard.values())]
        x, y = (sum(place[axis] for place in places) / len(places) for axis in (0, 1))
        return towards(own, x - own.x, y - own.y, self.SPEED)

    def watch(self, now: float, states: Sequence[State]) -> None:
        if not self.over:
            self._now = now
            x, y = (sum(state[axis] for state in states) / len(states) for axis in (0, 1))
            self.over = all(math.hypot(one.x - x, one.y - y) <= self.MEET_M for one in states)

    def numbers(self) -> dict[str, float | None]:
        return {"time_to_meet_s": self._now, "met": float(self.over)}


BUILT_IN = {"formation": Formation, "rendezvous": Rendezvous}


def towards(own: State, x: float, y: float, most: float) -> Command:
    """The command that makes a robot's velocity (x, y) as far as it can, m/s.

    :param most: m/s
    """
    wanted = math.hypot(x, y)
    if wanted < 1e-3:
        return 0.0, 0.0
    off = math.remainder(math.atan2(y, x) - own.heading, 2 * math.pi)
    return min(wanted, most) * max(0.0, math.cos(off)), max(-MAX_TURN, min(MAX_TURN, 2 * off))


def task_class(name: str) -> type[Task]:
    """The class of a task, by its name or as ``module:Class``.

    :raises ConfigError: where there is none of that name; says what went wrong
    """
    module, colon, attribute = name.partition(":")
    kind: Any = BUILT_IN.get(name)
    if kind is None and colon:
        try:
            kind = getattr(importlib.import_module(module), attribute)
        except (ImportError, AttributeError) as error:
            raise ConfigError(f"task = {name!r}: {error}; put the module on PYTHONPATH") from error
    if not (isinstance(kind, type) and issubclass(kind, Task)):
        known = ", ".join(BUILT_IN)
        raise ConfigError(f"task = {name!r}: is no task; known are {known}, and module:Class, a subclass of Task")
    return kind


def make_task(name: str, robots: int, seed: int) -> Task:
    """A task by its name, or ``module:Class``.

    :raises ConfigError: where there is none of that name; says what went wrong
    """
    return task_class(name)(robots, random.Random(f"task {seed}"))


class TaskRobots:
    """Robots on an open plane, moved by a task, and their odometry. Obstacles stop nobody.

    :param settings: rate and noise of the odometry, the seed, and the obstacles
    :param commanded: robots that do what :meth:`follow` tells them, and nothing before
    :ivar world: obstacles between them
    """

    def __init__(self, task: Task, settings: SimSettings, commanded: Collection[int] = ()) -> None:
        self._task, self._settings, self._tick = task, settings, 0
        self.world = World(settings.size_m, settings.obstacles, np.random.default_rng([settings.seed, 0]))
        self._states = [task.start(number) for number in range(task.robots)]
        self._log: list[list[State]] = []
        self._heard: list[dict[int, LastHeard]] = [{} for _ in self._states]
        self._commands = dict.fromkeys(commanded, (-math.inf, (0.0, 0.0)))
        self.stamp_from(settings.start_time_s)
        self._decide()

    def stamp_from(self, start_time_s: float) -> None:
        """Stamp odometry with this + t, s. To be called before anything is measured."""
        self._start_s = start_time_s
        self._sensors = [
            Sensors(self._settings, self.world, number + 1, state, round(start_time_s * 1e9))
            for number, state in enumerate(self._states)
        ]

    def advance(self, now: float) -> None:
        """Move all robots to a time. What they have heard before it has been taken."""
        while (self._tick + 1) * TICK <= now + 1e-9:
            self._states = [state.after(TICK) for state in self._states]
            self._tick += 1
            self._decide()

    def _decide(self) -> None:
        now, states = self._tick * TICK, self._states
        self._task.watch(now, states)
        commands = [self._command(number, now, own) for number, own in enumerate(states)]
        self._states = [_following(own, *command) for own, command in zip(states, commands, strict=True)]
        self._log.append(self._states)

    def at(self, now: float) -> tuple[Floats, Floats]:
        """Places in m and velocities in m/s of all robots at the last full period, each of shape (robots, 2)."""
        self.advance(now)
        return places_and_velocities(self._log[int(now / TICK + 1e-9)])

    def _command(self, number: int, now: float, own: State) -> Command:
        if number not in self._commands:
            return self._task.command(number, now, own, self._heard[number])
        given, command = self._commands[number]
        return command if now - given <= COMMAND_HOLDS_S else (0.0, 0.0)

    def follow(self, robot: int, command: Command, now: float) -> None:
        """A robot's controller has sent a command."""
        self._commands[robot] = now, command

    def heard(self, robot: int, sender: int, odometry: bytes, now: float) -> None:
        """A robot's link has delivered the odometry of another one."""
        self.advance(now)
        made_ns, state = read_odometry(odometry)
        before = self._heard[robot].get(sender)
        made_s = made_ns * 1e-9 - self._start_s
        if before is None or made_s > before.made_s:
            self._heard[robot][sender] = LastHeard(made_s, state)

    def odometry(self, robot: int, now: float) -> bytes:
        """What a robot sends at a time: its place and velocity."""
        self.advance(now)
        state = self._states[robot].after(min(TICK, max(0.0, now - self._tick * TICK)))
        self._sensors[robot].localize(now, state)
        return self._sensors[robot].read("odom", now, state, ())

    def times(self, robot: int, duration_s: float) -> Iterator[float]:
        """When a robot measures its odometry, s."""
        rate, phase = self._settings.odom_rate, random.Random(f"phase {self._settings.seed} {robot}").random()
        count = 0
        while (at := (count + phase) / rate) < duration_s:
            yield at
            count += 1

    @property
    def over(self) -> bool:
        """Whether the task has ended."""
        return self._task.over

    def numbers(self) -> dict[str, float | None]:
        """How well all robots did, by name."""
        return self._task.numbers()


def _following(own: State, speed: float, turn: float) -> State:
    """A robot that follows a command as far as it can within a period."""
    (slowest, fastest), (least, most) = own.reach()
    return own.towards(max(slowest, min(fastest, speed)), max(least, min(most, turn)))
