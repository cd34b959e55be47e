"""The robots that a scenario consists of: their settings, and what lies between them.

Invariants: robots that offer messages come first; a robot has a path to whoever it may concern.
"""

from __future__ import annotations

import random
from collections.abc import Iterable, Sequence
from dataclasses import dataclass as plain_dataclass
from dataclasses import replace

from pydantic.dataclasses import dataclass

from gr_ros2.settings.config import (
    STRICT,
    ChannelConfig,
    PathConfig,
    ScenarioChannel,
    Transceiver,
)
from gr_ros2.settings.robot import RobotConfig
from gr_ros2.wire import BROADCAST
from gr_ros2_lab.medium.base import RadioPath

STARTED_S = 1.0
"""s within which the robots of a run begin to send. Hellos of robots that begin together would collide for ever."""
_APART, _BACK = 7919, 100_003
"""Differences between the seeds of paths. Those between repetitions are smaller."""


@dataclass(frozen=True, kw_only=True, config=STRICT)
class ScenarioRobot(Transceiver, RobotConfig):
    """One of the robots of a scenario. What is not set in it is as above them; its name is /robot_1, /robot_2, …"""


@plain_dataclass(frozen=True)
class RobotSettings:
    """One robot of a run.

    :param config: its settings
    :param takes: whether messages of others come out at it
    :param paths: what lies between it and those that may hear it. Levels may follow from gains or positions instead
    :param levels: power that it transmits, dBm, and noise figure of its receiver, dB
    :param start_s: in simulated time, when it begins to send, s
    """

    config: RobotConfig
    takes: bool
    paths: tuple[RadioPath, ...]
    levels: tuple[float, float]
    start_s: float = 0.0

    @property
    def robot_id(self) -> int:
        """Its id on the wire."""
        return self.config.robot_id

    @property
    def namespace(self) -> str:
        """Of what it sends on its ROS graph; '' where it offers nothing."""
        return self.config.namespace if self.config.sends else ""


def senders_of(robots: Iterable[RobotSettings]) -> list[RobotConfig]:
    """Those that offer messages."""
    return [robot.config for robot in robots if robot.config.sends]


def settings_of_all(
    robots: Sequence[ScenarioRobot],
    channel: ScenarioChannel,
    differing: Sequence[PathConfig],
    *,
    shared: bool,
    leveled: bool,
    seed: int,
) -> tuple[RobotSettings, ...]:
    """The robots of a run.

    :param channel: between all of them
    :param differing: the paths that have another one; of several that fit, the last counts
    :param shared: whether they use one channel, rather than one each
    :param leveled: whether the level of each path follows from gains
    """
    starts = random.Random(f"starts {seed}")
    offering = [number for number, robot in enumerate(robots) if robot.sends]
    made = []
    for number, robot in enumerate(robots):
        hearers = [other for other, one in enumerate(robots) if other != number and one.receives]
        if not robot.sends and not shared:  # its reports concern those that send
            hearers = [other for other in hearers if other in offering]
        if robot.direction == "receive":
            hearers = []
        paths = [_path(robots, number, other, channel, differing, shared=shared, leveled=leveled) for other in hearers]
        made.append(
            RobotSettings(
                robot,
                robot.receives and bool(set(offering) - {number}),
                tuple(paths),
                channel.levels(robot),
                starts.uniform(0.0, STARTED_S) if shared or len(offering) > 2 else 0.0,
            )
        )
    return tuple(made)


def _path(
    robots: Sequence[ScenarioRobot],
    number: int,
    other: int,
    channel: ScenarioChannel,
    differing: Sequence[PathConfig],
    *,
    shared: bool,
    leveled: bool,
) -> RadioPath:
    """What lies between two robots, by their places. Where it draws random numbers, it has a seed of its own."""
    own = [one for one in differing if one.between(robots[number].robot_id, robots[other].robot_id)]
    found: ChannelConfig = own[-1] if own else channel
    if not shared:
        found = replace(found, seed=found.seed + _seed_of(number, other))
    elif leveled or found.loses_packets or found.doppler_hz:
        found = replace(found, seed=found.seed + _APART * (1 + number * BROADCAST + other))
    return RadioPath(other, found, own[-1].delay_s if own else 0.0)


def _seed_of(number: int, other: int) -> int:
    """By how much the seed of a path between robots with a channel each differs from that of the first path."""
    if number == 0:
        return 0 if other == 1 else other * _BACK
    return _BACK + number - 1 if other == 0 else _APART * (1 + number * BROADCAST + other)
