"""Robots in real time: a link for each, with a ROS graph of its own, and the medium between them.

The medium is that of ``gr-ros2 medium`` in lock step, in a thread of this process. So links that are late delay the
others, and nothing is lost because the computer is slow.

Invariants: all links follow the clock of the medium, which never goes faster than real time; where robots are counts
from the begin of the run; what a robot keeps of its starts is forgotten with the run.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import fields
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from gr_ros2.core.errors import GrRos2Error, RunError
from gr_ros2.link.lateness import Lateness
from gr_ros2.medium.base import Surroundings
from gr_ros2.phy import Phy
from gr_ros2.radio.config import LinkConfig
from gr_ros2.radio.medium import MediumConfig, MediumProcess, MediumRobot
from gr_ros2.radio.robot_link import RobotLink
from gr_ros2.run.load import source_names
from gr_ros2.run.recorders import RunRecords
from gr_ros2.run.scenario import Scenario
from gr_ros2.settings.config import AnyLink, ChannelConfig, DiagnosticsConfig, build, replaced
from gr_ros2.settings.registry import Registry

_FOUND_S = 20.0
"""s within which all links have to answer the medium."""
_POLL_S = 0.02
_QUIET_S = 0.3
"""s on the clock of the links, after which a packet that has left a robot has arrived."""


class LiveRobot:
    """A robot: its link, and what the others have for it.

    :param way: the scenario in which it sends
    :param others: those in which the others do
    :ivar topics: topic id of every topic that it sends, by absolute name
    """

    def __init__(self, way: Scenario, others: Sequence[Scenario], registry: Registry, link: RobotLink) -> None:
        self.scenario, self.link = way, link
        self.src_id = way.ros_source.src_id()
        self.topics = source_names(way, registry)
        self.source, self.sink = link.source, link.sink
        self.input = self.output = link.source.middleware
        self._heard = {other.ros_source.src_id(): list(source_names(other, registry).values()) for other in others}
        for src_id, topic_ids in self._heard.items():
            self.sink.outputs.announce(src_id, topic_ids)

    def output_topics(self) -> dict[str, str]:
        """Name and type of every topic of the others, as it comes out here."""
        form, topics = self.scenario.ros_sink.namespace_format, self.sink.registry
        return {
            topics[topic_id].republished(form, src_id): topics[topic_id].type_name
            for src_id, topic_ids in self._heard.items()
            for topic_id in topic_ids
        }

    def empty(self, unresolved: bool) -> bool:
        """Whether nothing is left here, or on the air.

        :param unresolved: whether the result of some messages is open; then it is useful to wait briefly for the air
        """
        if not self.source.idle or self.link.radio.counts().backlog:
            return False
        until = self.link.front_end.clock() + _QUIET_S
        while unresolved and self.link.front_end.clock() < until:
            time.sleep(_POLL_S)
        return True

    def counters(self) -> dict[str, Any]:
        """What each part counted."""
        stats = self.link.stats()
        return {name: stats[name] for name in ("source", "sink", "packets")}


class LiveTeam:
    """The robots of a scenario and the medium between them, ready to start.

    :param scenario: in which every robot's graph has a domain of its own
    :param phys: of the robots
    :param around: who hears whom
    :param records: observe the robots
    :param stack: closes what is opened here
    :raises ConfigError: for a PHY whose bursts cannot be summed
    """

    def __init__(
        self,
        scenario: Scenario,
        registry: Registry,
        phys: Sequence[Phy],
        around: Surroundings,
        *,
        records: RunRecords,
        stack: ExitStack,
    ) -> None:
        folder = Path(stack.enter_context(TemporaryDirectory(prefix="gr-ros2-")))
        ways = scenario.directions()
        phy = replaced(scenario.phy, sample_rate=phys[0].sample_rate)
        ends = [tuple(f"ipc://{folder}/{number}-{what}" for what in ("sends", "hears")) for number in range(len(ways))]
        self._around = around
        self._medium = MediumProcess(
            MediumConfig(
                name=scenario.name,
                phy=phy,
                packet_len=scenario.packet_len,
                robots=tuple(MediumRobot(connect=sends, bind=hears) for sends, hears in ends),
                seed=scenario.seed,
            ),
            around=around,
        )
        stack.callback(self._medium.close)
        self.ways: list[LiveRobot] = []
        for number, (way, (sends, hears)) in enumerate(zip(ways, ends, strict=True)):
            front_end = {"name": "zmq", "bind": sends, "connect": [hears], "medium_process": "lockstep"}
            config = _link_of(replaced(way, phy=phy), front_end, folder / f"robot-{number}")
            link = RobotLink(config, observer=records.of(number, way.ros_source.src_id()))
            stack.callback(link.stop)
            self.ways.append(LiveRobot(way, [other for other in ways if other is not way], registry, link))
        self.links = [robot.link.radio for robot in self.ways]
        self.clock = self.ways[0].link.front_end.clock
        self._thread = threading.Thread(target=self._carry, name="gr-ros2-medium", daemon=True)
        self._over = threading.Event()
        self._error: Exception | None = None
        self._slow_s = 0.0
        stack.callback(self._end)

    listened = 1
    """Robots on whose graphs is recorded what comes out."""
    channels = 1

    @property
    def graphs(self) -> tuple[tuple[str, int | None], ...]:
        """Where other programs can join in: what is there, and the ROS domain."""
        return tuple(
            (f"the graph of {robot.scenario.ros_source.namespace}", robot.input.domain_id) for robot in self.ways
        )

    def start(self) -> None:
        """Start the links and the medium, and wait until all are there.

        :raises RunError: when a link does not answer
        """
        for robot in self.ways:
            robot.link.start()
        self._thread.start()
        limit = time.monotonic() + _FOUND_S
        while self._medium.robots < len(self.ways):
            self.check()
            if time.monotonic() > limit:
                raise RunError(
                    f"{self._medium.robots} of {len(self.ways)} robots have answered the medium within {_FOUND_S:g} s; "
                    "this computer is too slow for them: take fewer, or simulated time"
                )
            time.sleep(_POLL_S)

    def run_began(self, now: float) -> None:  # noqa: ARG002 - the medium has a clock of its own
        """Count from now on where the robots are, and how long the medium waits for the computer."""
        self._around.begin(self._medium.now)
        self._slow_s = self._medium.lost_s

    def check(self) -> None:
        """:raises GrRos2Error: when the medium or a link cannot go on"""
        if self._error is not None:
            raise self._error
        for robot in self.ways:
            robot.link.check()

    def stop(self) -> None:
        """Stop the links, and then the medium, for which they may wait."""
        for robot in self.ways:
            robot.link.stop()
        self._end()

    def lateness(self, records: RunRecords) -> dict[str, list[Lateness]] | None:  # noqa: ARG002 - as of a direction
        """None: the links wait for the computer."""
        return None

    def counters(self) -> dict[str, Any]:
        """What each robot counted, the first as in a run in one direction, and the medium. ``slow_s``: s for which the
        robots waited for the computer."""
        first, *others = (robot.counters() for robot in self.ways)
        medium = {**self._medium.counted, "slow_s": self._medium.lost_s - self._slow_s}
        return {**first, "robots": others, "medium": medium}

    def _carry(self) -> None:
        try:
            self._medium.run(over=self._over)
        except (GrRos2Error, OSError, ValueError) as error:
            self._error = error

    def _end(self) -> None:
        self._over.set()
        if self._thread.ident is not None:
            self._thread.join()


def _link_of(way: Scenario, front_end: dict[str, Any], state: Path) -> LinkConfig:
    """The link of a robot, by the settings of its scenario."""
    source = replaced(way.ros_source, state=str(state))
    graph = {"middleware": source.middleware, "domain_id": source.domain_id}
    own = {
        "ros_source": source,
        "ros_sink": replaced(way.ros_sink, **graph),
        "channel": ChannelConfig(),
        "front_end": front_end,
        "diagnostics": DiagnosticsConfig(period_s=0),
    }
    return build(LinkConfig, {field.name: getattr(way, field.name) for field in fields(AnyLink)} | own)
