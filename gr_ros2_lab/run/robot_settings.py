"""The robots that a scenario consists of, and what a file writes for them. The short forms ``back``, ``receivers`` and
``reports`` end here: whatever runs, records or forecasts a scenario knows robots alone.

Invariants: robots that offer messages come first; both halves of a robot are on one graph unless settings say
otherwise; a receiver that reports has a source id of its own.
"""

from __future__ import annotations

import random
from collections.abc import Iterable, Sequence
from dataclasses import dataclass as plain_dataclass
from dataclasses import replace

from pydantic import Field
from pydantic.dataclasses import dataclass

from gr_ros2.settings.config import (
    STRICT,
    OneWay,
    ScenarioChannel,
    Seconds,
    SinkConfig,
    SourceConfig,
    Transceiver,
    replaced,
    robot_of,
)
from gr_ros2.settings.fields import AUTO
from gr_ros2.wire import BROADCAST
from gr_ros2_lab.medium.base import Path
from gr_ros2_lab.medium.gains import all_paths

STARTED_S = 1.0
"""s within which the robots of a run begin to send. Hellos of robots that begin together would collide for ever."""


@dataclass(frozen=True, kw_only=True, config=STRICT)
class Back(OneWay):
    """The reverse direction of a two-way scenario, at the same time on a second channel (full duplex).

    What is not set is as in the forward direction, with the two graphs swapped; of ``channel`` the seed differs.

    :param ros_source: the second robot's sending block; needs a ``namespace`` or ``robot_id`` of its own
    :param ros_sink: the first robot's receiving block
    :param channel: what lies between them
    """

    channel: ScenarioChannel = Field(default_factory=ScenarioChannel)


@dataclass(frozen=True, kw_only=True, config=STRICT)
class Reports:
    """The reverse direction for reports of what was heard, on a channel of its own (version 1).

    :param channel: what lies between them and the sender; what is not set is as forward, but for the seed
    :param delay_s: s that a report takes beside its airtime
    """

    channel: ScenarioChannel = Field(default_factory=ScenarioChannel)
    delay_s: Seconds = 0.0


@dataclass(frozen=True, kw_only=True, config=STRICT)
class RobotConfig(Transceiver):
    """One of the robots that share a medium. What is not set in its block is as in the scenario's, but for the
    namespace: ``/robot_1``, ``/robot_2``, …

    :param ros_source: its sending block
    """

    ros_source: SourceConfig = Field(default_factory=SourceConfig)


@plain_dataclass(frozen=True)
class RobotSettings:
    """One robot of a run.

    :param source: settings of its sending half; None: it offers nothing, and sends nothing but reports
    :param sink: settings of its receiving half; None: it has none
    :param paths: what lies between it and those that may hear it. Levels may follow from gains or positions instead
    :param levels: power that it transmits, dBm, and noise figure of its receiver, dB
    :param start_s: in simulated time, when it begins to send, s
    """

    source: SourceConfig | None
    sink: SinkConfig | None
    paths: tuple[Path, ...]
    levels: tuple[float, float]
    start_s: float = 0.0

    @property
    def robot_id(self) -> int:
        """Its id on the wire, -1 for none."""
        return robot_of(self.source, self.sink)

    @property
    def namespace(self) -> str:
        """Of what it sends on its ROS graph; '' where it offers nothing."""
        return "" if self.source is None else self.source.namespace


def sources_of(robots: Iterable[RobotSettings]) -> list[SourceConfig]:
    """The sending halves of those that offer messages."""
    return [robot.source for robot in robots if robot.source is not None]


def all_to_all(
    robots: Sequence[RobotConfig], sink: SinkConfig, channel: ScenarioChannel, *, leveled: bool, seed: int
) -> tuple[RobotSettings, ...]:
    """Robots that all send and receive.

    :param sink: settings that they have in common but for the graph, which is that of the source
    :param leveled: whether the level of each path follows from gains
    """
    starts = random.Random(f"starts {seed}")
    return tuple(
        RobotSettings(
            source := robot.ros_source,
            replaced(sink, middleware=source.middleware, domain_id=source.domain_id),
            tuple(paths),
            channel.levels(robot),
            starts.uniform(0.0, STARTED_S),
        )
        for robot, paths in zip(robots, all_paths(channel, len(robots), leveled=leveled), strict=True)
    )


def both_ways(
    source: SourceConfig, sink: SinkConfig, channel: ScenarioChannel, back: Back
) -> tuple[RobotSettings, ...]:
    """Two robots. The sink of each is configured beside the source that it hears."""
    levels = channel.levels(Transceiver())
    return (
        RobotSettings(source, back.ros_sink, (Path(1, channel),), levels),
        RobotSettings(back.ros_source, sink, (Path(0, back.channel),), levels),
    )


def one_way(
    source: SourceConfig, sink: SinkConfig, channels: Sequence[ScenarioChannel], reports: Reports | None
) -> tuple[RobotSettings, ...]:
    """A robot that sends, and those that receive.

    :param channels: to each receiver
    """
    levels = channels[0].levels(Transceiver())
    forward = tuple(Path(number, channel) for number, channel in enumerate(channels, 1))
    robots = [RobotSettings(source, None, forward, levels)]
    for number in range(len(channels)):
        own, back = sink, []
        if reports is not None:
            channel = replaced(reports.channel, seed=reports.channel.seed + number)
            back = [Path(0, channel, reports.delay_s)]
            if sink.robot_id in (AUTO, source.src_id()):
                own = replace(sink, robot_id=_free_id(source.src_id(), number))
        robots.append(RobotSettings(None, own, tuple(back), levels))
    return tuple(robots)


def _free_id(taken: int, number: int) -> int:
    """A source id for a receiver that reports and has no id of its own."""
    return BROADCAST - 1 - number - (BROADCAST - 1 - number <= taken)
