"""What a robot of the paper has beside the settings of every robot, and what of these it does not have.

Invariant: every setting of such a robot has an effect or is refused.
"""

from __future__ import annotations

from dataclasses import fields
from typing import Annotated, Any, Literal

from pydantic import Field
from pydantic.dataclasses import dataclass

from gr_ros2.core.errors import ConfigError
from gr_ros2.settings.config import CODING, STRICT, Seconds, build
from gr_ros2.settings.effect import refuse_given
from gr_ros2.settings.registry import Registry
from gr_ros2.settings.robot import RobotConfig, robot_from
from gr_ros2.wire import BROADCAST
from gr_ros2.wire.v0 import V0

_OF_TOPICS = (
    "queue",
    "deadline_s",
    "weight",
    "max_rate",
    "keep_s",
    "to",
    "instance",
    "camera",
    "depth_image",
)
_WITHOUT = (
    *("key", "seal", "state", "services", "commands", "beacon_s", "repair", "expected_loss", "hold_s", "max_age_s"),
    *(f"topics.*.{name}" for name in _OF_TOPICS),
    *("publish.topics.*.deadline_s", "publish.topics.*.max_age_s", "offer"),
)
_WHY = "the paper's blocks have no such setting; leave it out"


@dataclass(frozen=True, kw_only=True, config=STRICT)
class PaperConfig:
    """What the paper's blocks have, ROS Source and ROS Sink, which speak version 0 (sections 4.3 and 4.4)."""

    dst_id: Annotated[int, Field(ge=0, le=BROADCAST, title="Destination ID")] = BROADCAST
    """destination id, 255 broadcast"""
    min_fragment: Annotated[int, Field(ge=1, le=65535, title="Smallest fragment (bytes)")] = 16
    """k_min, lower bound on an entry's payload, bytes"""
    greedy: bool = False
    """several entries of one topic in a packet, back to back"""
    flush_timeout_s: Seconds = 0.0
    """s a partly filled packet waits for further messages; 0 = it is sent at once"""
    hop: Annotated[int, Field(ge=0, le=15, title="Hop limit (hops)")] = 1
    """initial hop count (TTL) 0..15"""
    entry_ids: Annotated[Literal["sequential", "random"], Field(title="Entry IDs")] = "sequential"
    """random, as the paper has it, joins fragments of different messages on a lossy link"""
    compression: bool = False
    """code every message, which the paper leaves off"""
    reassembly_timeout_s: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 1.0
    """s an incomplete message is kept"""


def check(robot: RobotConfig, paper: PaperConfig) -> None:
    """Refuse settings that a robot of the paper does not have, and those that do not go together.

    :raises ValueError: naming setting, value and remedy
    """
    refuse_given(robot, _WITHOUT, _WHY)
    refuse_given(robot, ("compression",), "the paper's blocks have a setting of their own; set paper.compression")
    if robot.packet_len < V0.min_packet_len:
        raise ValueError(f"packet_len = {robot.packet_len}: the paper's packets need at least {V0.min_packet_len}")
    if not paper.compression:
        refuse_given(
            robot,
            tuple(f"topics.*.{option}" for option in CODING),
            "no message is coded without compression; set paper.compression: true, or leave it out",
        )
    most = V0.single_entry_payload(robot.packet_len)
    if robot.sends and paper.min_fragment > most:
        raise ValueError(
            f"min_fragment = {paper.min_fragment} does not fit packet_len = {robot.packet_len}; at most {most}"
        )


def check_rows(registry: Registry) -> None:
    """Refuse options of a registry, and services, that the paper's blocks do not have.

    :raises ConfigError: naming topic, option and remedy
    """
    if registry.services:
        raise ConfigError(f"registry: {registry.services[0].name} is a service, which needs gr-ros2 link or ROS Link")
    for topic in registry:
        try:
            refuse_given(topic.options, _OF_TOPICS, _WHY, f"topic {topic.name}: ")
        except ValueError as error:
            raise ConfigError(f"registry: {error}") from None


def paper_from(**given: Any) -> tuple[RobotConfig, PaperConfig]:
    """A robot of the paper from settings in one list, as the blocks and GRC have them; see
    :func:`gr_ros2.settings.robot.robot_from`.

    :raises ConfigError: for an unknown setting, a value out of range, or settings that contradict each other
    """
    names = {item.name for item in fields(PaperConfig)}
    paper = build(PaperConfig, {name: value for name, value in given.items() if name in names})
    robot = robot_from(**{name: value for name, value in given.items() if name not in names})
    try:
        check(robot, paper)
    except ValueError as error:
        raise ConfigError(str(error)) from None
    return robot, paper
