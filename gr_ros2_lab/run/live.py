"""A run in real time: robots, each with its end of a link on its ROS graph, and one medium between them.

Invariants: every robot is a :class:`gr_ros2.radio.robot_link.RobotLink`; the only path between two robots is the
medium; everything that is opened is closed by the exit stack; what a robot keeps of its airtime is forgotten with the
run.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from gr_ros2.core.names import link_node
from gr_ros2.gr.ros_link import LinkBlock, RosLink
from gr_ros2.gr.sending import SendingBlock
from gr_ros2.link.lateness import Lateness
from gr_ros2.middleware import Middleware, join
from gr_ros2.middleware.bag import BagMiddleware
from gr_ros2.phy import Phy
from gr_ros2.radio.config import LinkConfig
from gr_ros2.radio.robot_link import RobotLink
from gr_ros2.settings.config import AirConfig, DiagnosticsConfig, PhyConfig, replaced
from gr_ros2.settings.registry import Registry
from gr_ros2.settings.robot import RobotConfig
from gr_ros2_lab.medium.base import Surroundings
from gr_ros2_lab.run.live_media import POLL_S, LiveChannel, LiveMedium, LockedSteps
from gr_ros2_lab.run.load import recorded_names, source_names
from gr_ros2_lab.run.outcome import by_sender
from gr_ros2_lab.run.paper_link import PaperLink
from gr_ros2_lab.run.passed_on import PassedOn
from gr_ros2_lab.run.recorders import RunRecords
from gr_ros2_lab.run.robot_settings import RobotSettings, senders_of
from gr_ros2_lab.run.robots import hearer_of, start_of_run
from gr_ros2_lab.run.scenario import Scenario

_QUIET_S = 0.3
"""s on the clock of the links, after which a packet that has left a robot has arrived, if nothing delays it."""


@dataclass(frozen=True)
class LiveRobot:
    """A robot that is ready to start.

    :param topics: topic id of every topic that it offers, by absolute name
    :param heard: name and type of every topic of the others, as it comes out here
    """

    settings: RobotSettings
    topics: Mapping[str, int]
    heard: Mapping[str, str]
    link: RobotLink

    @property
    def source(self) -> SendingBlock:
        """The block that sends."""
        return self.link.source

    @property
    def graph(self) -> Middleware:
        """Its participant on its ROS graph."""
        return self.source.middleware


class LiveRobots:
    """The robots of a scenario and the medium between them, ready to start.

    :param robots: those of the scenario, on domains of their own where it says so
    :param phy: of all robots
    :param around: who hears whom
    :param records: observe the robots
    :param stack: closes what is opened here
    :raises ConfigError: for a PHY or settings that the medium cannot have
    :ivar links: what an observer can read and change between them
    :ivar clock: of the run, s
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
        self._scenario, self._registry, self._phy, self._around = scenario, registry, phy, around
        kind: type[LiveMedium] = LockedSteps if phy.has_samples else PassedOn
        self._medium = kind(scenario, phy, around, stack)
        self._state = Path(stack.enter_context(TemporaryDirectory(prefix="gr-ros2-")))
        self.robots = [self._robot(number, robot, robots, records, stack) for number, robot in enumerate(robots)]
        stack.callback(self._medium.stop)
        self.offering = self.robots[: len(senders_of(robots))]
        """Those that offer messages."""
        self.recorded = [one for number, one in enumerate(self.robots) if one.heard and not records.place(number)]
        """Those of which the bag has what comes out: what counts in the tables of the first receiver."""
        every = [robot.link for robot in self.robots]
        senders = [number for number in range(len(every)) if around.reached(number)]
        self.links = [LiveChannel(self._medium, number, every) for number in senders]
        self.clock: Callable[[], float] = every[0].front_end.clock
        delays = [around.path(number, other).delay_s for number in senders for other in around.reached(number)]
        self._quiet_s = _QUIET_S + max(delays, default=0.0)

    @property
    def channels(self) -> int:
        """How many they use."""
        return 1 if self._scenario.duplex == "half" else len(self.offering)

    @property
    def sources(self) -> dict[int, SendingBlock]:
        """The blocks that send messages, by source id."""
        return {robot.settings.robot_id: robot.source for robot in self.offering}

    @property
    def graphs(self) -> tuple[tuple[str, int | None], ...]:
        """Where other programs can join in: what is there, and the ROS domain."""
        return tuple(
            (f"the graph of {robot.settings.namespace}", robot.graph.domain_id)
            if robot.settings.config.sends
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

    def start(self) -> None:
        """Start the links and the medium, and wait until all are there.

        :raises RunError: when a link does not answer
        """
        for robot in self.robots:
            robot.link.start()
        self._medium.start(len(self.robots))

    def began(self) -> None:
        """Messages come from now on."""
        self._medium.began()

    def check(self) -> None:
        """:raises GrRos2Error: when the medium or a link cannot go on"""
        self._medium.check()
        for robot in self.robots:
            robot.link.check()

    def stop(self) -> None:
        """Stop the medium, which would wait for a link that is gone, and then the links."""
        if not self._medium.waits:  # what one robot sends after another has stopped would be lost
            for robot in self.robots:
                robot.source.stop()
            time.sleep(POLL_S)
        self._medium.stop()
        for robot in self.robots:
            robot.link.stop()

    def alarms(self) -> Sequence[str]:
        """What is wrong with the medium now, one line each."""
        return self._medium.alarms()

    def empty(self, unresolved: bool) -> bool:
        """Whether nothing is left at the robots, or on its way.

        :param unresolved: whether the result of some messages is open; then it is useful to wait briefly for the air
        """
        if not all(source.idle for source in self.sources.values()):
            return False
        if any(robot.link.radio.counts().backlog for robot in self.robots):
            return False
        until = self.clock() + self._quiet_s
        while unresolved and self.clock() < until:
            self.check()
            time.sleep(POLL_S)
        return True

    def lateness(self) -> dict[str, list[Lateness]] | None:
        """How late packets were in each part; None where the robots wait for the computer."""
        if self._medium.waits:
            return None
        gates = [robot.link.radio.gate.lateness for robot in self.offering if self._phy.has_airtime]
        return {"gate": gates}

    def counters(self) -> dict[str, Any]:
        """What each part counted: of the first robot that sends and who hears it, of the second as ``back``, or of the
        others as ``robots``; of robots that are more than two, each has its own receiver's."""
        counted = []
        for number, robot in enumerate(self.offering):
            first = hearer_of(self._around, number)
            counted.append(
                {
                    "source": robot.source.stats(),
                    "sink": (robot if len(self.offering) > 2 else self.robots[first]).link.sink.stats(),
                    "channel": dict(self._medium.medium.lost.dropped[number, first]),
                    "packets": robot.link.stats()["packets"],
                }
            )
        return {**by_sender(counted), **self._medium.counters()}

    def _robot(
        self,
        number: int,
        settings: RobotSettings,
        robots: Sequence[RobotSettings],
        records: RunRecords,
        stack: ExitStack,
    ) -> LiveRobot:
        """A robot, whose receiving half knows the topics of the others from the start."""
        config, registry = settings.config, self._registry
        link = RobotLink(
            self._config(number, config),
            middleware=self._graph(config, stack),
            observer=records.of(number),
            instrumented=records.run_observers.instruments,
            front_end=self._medium.front_end(number),
            block=self._block(config),
        )
        stack.callback(link.stop)
        heard: dict[str, str] = {}
        for other in senders_of(robots) if settings.takes else ():
            if other is not config:
                src_id, ids = other.robot_id, source_names(other, registry).values()
                link.sink.outputs.announce(src_id, ids)
                topics = [link.sink.registry[topic_id] for topic_id in ids]
                heard |= {topic.republished(config.publish.as_, src_id): topic.type_name for topic in topics}
        return LiveRobot(settings, source_names(config, registry) if config.sends else {}, heard, link)

    def _config(self, number: int, robot: RobotConfig) -> LinkConfig:
        """The settings of a link, by those of its scenario."""
        own = {item.name: getattr(robot, item.name) for item in fields(RobotConfig)}
        air = {item.name: getattr(self._scenario, item.name) for item in fields(AirConfig)}
        phy = self._scenario.phy
        if self._phy.has_samples:
            phy = replaced(phy, sample_rate=self._phy.sample_rate, headroom=PhyConfig.headroom)
        changed = {"phy": phy, "state": str(self._state / str(number)), "diagnostics": DiagnosticsConfig(period_s=0)}
        return LinkConfig(**own | air | changed)

    def _block(self, robot: RobotConfig) -> Callable[..., LinkBlock]:
        """Makes the block between a robot's graph and its radio."""
        # A bag that is read as fast as the link takes it: the reader waits, so that nothing is dropped.
        waits = robot.sends and self._scenario.bag_path is not None and not self._scenario.bag_speed
        common: dict[str, Any] = {"registry": self._registry, "backpressure": waits}
        if self._scenario.paper is not None:
            return partial(PaperLink, paper=self._scenario.paper, seed=self._scenario.seed, **common)
        return partial(RosLink, start=start_of_run(self._scenario), **common)

    def _graph(self, robot: RobotConfig, stack: ExitStack) -> Middleware:
        """The participant of a robot on its ROS graph, or the recording that its messages come from."""
        if not robot.sends or (path := self._scenario.bag_path) is None:
            return stack.enter_context(join(robot.graph, link_node(robot.robot_id)))
        recorded_names(self._scenario, self._registry)  # raises if the recording has nothing for this link
        return stack.enter_context(BagMiddleware(path=path, speed=self._scenario.bag_speed))
