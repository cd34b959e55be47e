"""A run in real time: robots, each with its blocks on its ROS graph, and one medium between them.

The medium is one that all robots share (:class:`gr_ros2_lab.run.shared_channel.SharedChannel`), or a channel for each
robot that sends (:class:`gr_ros2_lab.run.own_channels.OwnChannels`).

Invariants: the only path between two robots is the medium; everything that is opened is closed by the exit stack.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any, Protocol

from gr_ros2.gr.receiving import ReceivingBlock
from gr_ros2.gr.sending import SendingBlock
from gr_ros2.link.lateness import Lateness
from gr_ros2.middleware import Middleware, join
from gr_ros2.observe.observers import LiveLink
from gr_ros2.phy import Phy
from gr_ros2.settings.registry import Registry
from gr_ros2.settings.robot import RobotConfig
from gr_ros2_lab.medium.base import Surroundings
from gr_ros2_lab.run.load import source_names
from gr_ros2_lab.run.outcome import by_sender
from gr_ros2_lab.run.own_channels import OwnChannels
from gr_ros2_lab.run.recorders import RunRecords
from gr_ros2_lab.run.robot_settings import RobotSettings, senders_of
from gr_ros2_lab.run.robots import hearer_of
from gr_ros2_lab.run.scenario import Scenario
from gr_ros2_lab.run.shared_channel import SharedChannel


class LiveMedium(Protocol):
    """Carries packets between the blocks of robots.

    :ivar blocks: of each robot, the one that sends and the one that receives; None for one that it does not have
    :ivar links: what an observer can read and change of it
    :ivar clock: of the run, s
    :ivar channels: how many there are
    """

    channels: int

    @property
    def blocks(self) -> Sequence[tuple[SendingBlock | None, ReceivingBlock | None]]: ...
    @property
    def links(self) -> Sequence[LiveLink]: ...
    @property
    def clock(self) -> Callable[[], float]: ...

    def start(self) -> None:
        """:raises GrRos2Error: when a robot cannot be reached"""

    def run_began(self, now: float) -> None:
        """Messages come from now on, s on the clock."""

    def check(self) -> None:
        """:raises GrRos2Error: when it cannot go on"""

    def stop(self) -> None:
        """Nothing is carried any more. Idempotent."""

    def empty(self, unresolved: bool) -> bool:
        """Whether nothing is on its way.

        :param unresolved: whether the result of some messages is open; then it is useful to wait briefly for the air
        """

    def lateness(self, records: RunRecords) -> dict[str, list[Lateness]] | None:
        """How late packets were in each part; None where the robots wait for the computer."""

    def counted(self, robot: int) -> dict[str, Any]:
        """What happened to the packets of a robot."""

    def counters(self) -> dict[str, Any]:
        """What it counted for all robots together."""


@dataclass(frozen=True)
class LiveRobot:
    """A robot that is ready to start.

    :param topics: topic id of every topic that it offers, by absolute name
    :param heard: name and type of every topic of the others, as it comes out here
    """

    settings: RobotSettings
    topics: Mapping[str, int]
    heard: Mapping[str, str]
    source: SendingBlock | None
    sink: ReceivingBlock | None

    @property
    def graph(self) -> Middleware:
        """Where it receives; of one that only sends, where it sends."""
        block = self.sink or self.source
        assert block is not None
        return block.middleware


class LiveRobots:
    """The robots of a scenario and the medium between them, ready to start.

    :param robots: those of the scenario, on domains of their own where it says so
    :param phy: of all robots
    :param around: who hears whom
    :param records: observe the robots
    :param stack: closes what is opened here
    :raises ConfigError: for a PHY or settings that the medium cannot have
    """

    def __init__(
        self,
        scenario: Scenario,
        robots: Sequence[RobotSettings],
        registry: Registry,
        phy: Phy,
        around: Surroundings,
        *,
        records: RunRecords,
        stack: ExitStack,
    ) -> None:
        kind: Callable[..., LiveMedium] = SharedChannel if scenario.duplex == "half" else OwnChannels
        self._scenario = scenario
        self.medium = kind(scenario, robots, registry, phy, around, records=records, stack=stack)
        senders = senders_of(robots)
        self.robots = [
            _robot(registry, settings, senders, blocks)
            for settings, blocks in zip(robots, self.medium.blocks, strict=True)
        ]
        self.offering = self.robots[: len(senders)]
        """Those that offer messages."""
        self.recorded = [one for number, one in enumerate(self.robots) if one.heard and not records.place(number)]
        """Those of which the bag has what comes out: what counts in the tables of the first receiver."""
        self._hearers = [hearer_of(around, number) for number in range(len(senders))]

    @property
    def sources(self) -> dict[int, SendingBlock]:
        """The blocks that send messages, by source id."""
        return {robot.settings.robot_id: robot.source for robot in self.offering if robot.source is not None}

    @property
    def graphs(self) -> tuple[tuple[str, int | None], ...]:
        """Where other programs can join in: what is there, and the ROS domain."""
        return tuple(
            (f"the graph of {robot.settings.namespace}", robot.source.middleware.domain_id)
            if robot.settings.config.sends and robot.source is not None
            else ("the graph on which messages come out", robot.graph.domain_id)
            for robot in self.robots
        )

    def graph_of(self, src_id: int, stack: ExitStack) -> Middleware:
        """The graph of a simulated robot: a participant of its own on that of its source, or else the graph at the
        other end of the link."""
        for robot in self.offering:
            if robot.settings.robot_id == src_id:
                return stack.enter_context(join(robot.settings.config.graph, f"gr_ros2_robot_{src_id}"))
        return self.robots[1].graph

    def empty(self, unresolved: bool) -> bool:
        """Whether nothing is left at the robots, or on its way; see :meth:`LiveMedium.empty`."""
        return all(source.idle for source in self.sources.values()) and self.medium.empty(unresolved)

    def counters(self) -> dict[str, Any]:
        """What each part counted: of the first robot that sends and who hears it, of the second as ``back``, or of the
        others as ``robots``; of robots that are more than two, each has its own receiver's."""
        counted = []
        for number, (robot, hearer) in enumerate(zip(self.offering, self._hearers, strict=True)):
            sink = (robot if len(self.offering) > 2 else self.robots[hearer]).sink
            stats = {name: block.stats() for name, block in (("source", robot.source), ("sink", sink)) if block}
            counted.append({**stats, **self.medium.counted(number)})
        return {**by_sender(counted), **self.medium.counters()}


def _robot(
    registry: Registry,
    settings: RobotSettings,
    senders: Sequence[RobotConfig],
    blocks: tuple[SendingBlock | None, ReceivingBlock | None],
) -> LiveRobot:
    """A robot, whose sink knows the topics of the others from the start."""
    source, sink = blocks
    heard: dict[str, str] = {}
    for other in senders:
        if sink is not None and sink.registry and other is not settings.config:
            src_id, ids = other.robot_id, source_names(other, registry).values()
            sink.outputs.announce(src_id, ids)
            topics = [sink.registry[topic_id] for topic_id in ids]
            heard |= {topic.republished(sink.config.publish.as_, src_id): topic.type_name for topic in topics}
    offered = source_names(settings.config, registry) if settings.config.sends else {}
    return LiveRobot(settings, offered, heard, source, sink)
