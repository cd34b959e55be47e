"""The robots of a scenario with a ``task``: they act on what comes out of their links, in simulated and in real time.

In real time they publish their odometry on the graph of each robot, and with ``controller: ros`` do what is published
on ``cmd_vel`` there.

Invariants: a message is made at the time at which it is offered, from where its robot is then; any thread may call.
"""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from heapq import merge
from operator import attrgetter

from gr_ros2.core.arrays import Floats
from gr_ros2.core.errors import ConfigError
from gr_ros2.link import Delivered
from gr_ros2.middleware import Middleware, Qos
from gr_ros2.middleware.base import Subscription
from gr_ros2.settings.registry import Registry
from gr_ros2_lab.run.load import source_names
from gr_ros2_lab.run.robot_settings import senders_of
from gr_ros2_lab.run.scenario import Scenario
from gr_ros2_lab.sim.sensors import TYPES, read_command
from gr_ros2_lab.sim.tasks import TaskRobots, make_task
from gr_ros2_lab.sim.world import World


@dataclass(frozen=True)
class _Made:
    """A robot's odometry, measured when it is asked for."""

    t: float
    topic: str
    topic_id: int
    measure: Callable[[float], bytes]

    @property
    def payload(self) -> bytes:
        return self.measure(self.t)


class TaskRun:
    """The robots of a scenario with a ``task``.

    :ivar settings: of their odometry
    :ivar robot_ids: their source ids
    :ivar commands: by topic, how many came from a graph; ``unreadable``: those that are no finite numbers
    :raises ConfigError: for an unknown task, or a registry with more than odometry
    """

    def __init__(self, scenario: Scenario, registry: Registry) -> None:
        senders = senders_of(scenario.all_robots)
        self.settings, self._duration_s = scenario.sim, scenario.duration_s
        self.robot_ids = tuple(robot.robot_id for robot in senders)
        self.commands: Counter[str] = Counter()
        self._namespaces = [robot.namespace for robot in senders]
        self._topics: list[tuple[str, int]] = []
        for robot in senders:
            names = source_names(robot, registry)
            if list(names) != [f"{robot.namespace}/odom"]:
                raise ConfigError(
                    f"task = {scenario.task!r}: its robots send their odometry alone, and {scenario.registry} has "
                    f"{', '.join(names) or 'nothing'}; set registry to odom.csv"
                )
            self._topics += names.items()
        task = make_task(scenario.task, len(senders), scenario.seed)
        self._commanded = [] if scenario.controller == "task" else [*{*range(len(senders))} - {*task.scripted}]
        self._robots = TaskRobots(task, scenario.sim, self._commanded)
        self._subscriptions: dict[str, Subscription] = {}
        self._clock: Callable[[], float] = lambda: 0.0
        self._began = 0.0
        self._lock = threading.Lock()

    # ---- what they send

    def namespace(self, robot_id: int) -> str:
        """Where a robot's topics are."""
        return self._namespaces[self.robot_ids.index(robot_id)]

    def topics(self) -> dict[str, str]:
        """Topic name without namespace -> type."""
        return {"odom": TYPES["odom"]}

    def offered(self) -> list[Iterator[_Made]]:
        """What each robot offers, in the order of time."""
        return [self._of(number, self._duration_s) for number in range(len(self._topics))]

    def drive_ahead(self, duration_s: float) -> None:
        """Nothing: the robots act on what they hear."""

    def messages(self, duration_s: float, start_time_s: float | None = None) -> Iterator[_Made]:
        """All of them together, see :meth:`gr_ros2_lab.sim.fleet.Fleet.messages`."""
        if start_time_s is not None:
            self._robots.stamp_from(start_time_s)
        return merge(*(self._of(number, duration_s) for number in range(len(self._topics))), key=attrgetter("t"))

    def _of(self, number: int, duration_s: float) -> Iterator[_Made]:
        measure = partial(self._measure, number)
        for at in self._robots.times(number, duration_s):
            if self.over:
                return
            yield _Made(at, *self._topics[number], measure)

    def _measure(self, number: int, at: float) -> bytes:
        with self._lock:
            return self._robots.odometry(number, at)

    @property
    def over(self) -> bool:
        """Whether all is done: they send nothing more."""
        return self._robots.over

    @property
    def world(self) -> World:
        """The obstacles between them."""
        return self._robots.world

    def at(self, now: float) -> tuple[Floats, Floats]:
        """Where they are, see :meth:`gr_ros2_lab.sim.tasks.TaskRobots.at`."""
        with self._lock:
            return self._robots.at(now)

    # ---- what they act on

    def join(self, graphs: Mapping[int, Middleware], clock: Callable[[], float]) -> None:
        """Take commands from the graphs of the robots.

        :param graphs: by source id
        :param clock: of the run, s
        """
        self._clock = clock
        for number in self._commanded:
            name = f"{self._namespaces[number]}/cmd_vel"
            take = partial(self._take, number, name)
            graph = graphs[self.robot_ids[number]]
            self._subscriptions[name] = graph.subscribe(name, TYPES["cmd_vel"], Qos(), take)

    def uncommanded(self) -> list[str]:
        """Topics of commands that nobody publishes."""
        return [name for name, subscription in self._subscriptions.items() if not subscription.matched()]

    def begin(self, now: float) -> None:
        """The run begins at a time on its clock."""
        self._began = now

    def delivered(self, robot: int, event: Delivered, now: float) -> None:
        """A message has come out of a robot's link."""
        if event.src_id in self.robot_ids:
            sender = self.robot_ids.index(event.src_id)
            with self._lock:
                self._robots.heard(robot, sender, event.payload, min(now - self._began, self._duration_s))

    def _take(self, number: int, name: str, payload: bytes) -> None:
        command = read_command(payload)
        self.commands[name if command is not None else "unreadable"] += 1
        if command is not None:
            with self._lock:
                self._robots.follow(number, command, self._clock() - self._began)

    def numbers(self, played_s: float) -> dict[str, float | None]:
        """How well the task was done, see :meth:`gr_ros2_lab.sim.tasks.Task.numbers`."""
        with self._lock:
            self._robots.advance(played_s)
            return self._robots.numbers()
