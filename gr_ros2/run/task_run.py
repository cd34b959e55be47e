"""A run whose robots act on what comes out of their links: the simulator's robots and the link in one loop.

Invariant: a message is made at the time at which it is offered, from where its robot is then.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from gr_ros2.core.errors import ConfigError
from gr_ros2.link import Delivered
from gr_ros2.run.load import source_names
from gr_ros2.run.scenario import Scenario
from gr_ros2.settings.registry import Registry
from gr_ros2.sim.tasks import TaskRobots, make_task


@dataclass(frozen=True)
class _Made:
    """A robot's odometry, measured when it is asked for."""

    t: float
    topic_id: int
    robot: int
    robots: TaskRobots

    @property
    def payload(self) -> bytes:
        return self.robots.odometry(self.robot, self.t)


class TaskRun:
    """The robots of a scenario with a ``task``.

    :param ways: one scenario per robot
    :raises ConfigError: for an unknown task, or a registry with more than odometry
    """

    def __init__(self, scenario: Scenario, ways: Sequence[Scenario], registry: Registry) -> None:
        self._numbers = {way.ros_source.src_id(): number for number, way in enumerate(ways)}
        self._names = [source_names(way, registry) for way in ways]
        for way, names in zip(ways, self._names, strict=True):
            if list(names) != [f"{way.ros_source.namespace}/odom"]:
                raise ConfigError(
                    f"task = {scenario.task!r}: its robots send their odometry alone, and {scenario.registry} has "
                    f"{', '.join(names) or 'nothing'}; set registry to odom.csv"
                )
        self._robots = TaskRobots(make_task(scenario.task, len(ways), scenario.seed), scenario.sim)
        self._duration_s = scenario.duration_s

    def messages(self) -> list[Iterator[_Made]]:
        """What each robot offers, in the order of time."""
        return [self._of(number, *names.values()) for number, names in enumerate(self._names)]

    def _of(self, number: int, topic_id: int) -> Iterator[_Made]:
        for at in self._robots.times(number, self._duration_s):
            yield _Made(at, topic_id, number, self._robots)

    def delivered(self, robot: int, event: Delivered, now: float) -> None:
        """A message has come out of a robot's link."""
        sender = self._numbers.get(event.src_id)
        if sender is not None:
            self._robots.heard(robot, sender, event.payload, now)

    def numbers(self) -> dict[str, float | None]:
        """How well the task was done, see :meth:`gr_ros2.sim.tasks.Task.numbers`."""
        self._robots.advance(self._duration_s)
        return self._robots.numbers()
