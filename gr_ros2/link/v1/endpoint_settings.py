"""The settings of an endpoint of version 1, about itself and its radio.

Invariant: this module holds values only; every default suits a radio of some kB/s between two robots.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from gr_ros2.core.errors import ConfigError
from gr_ros2.core.tuning import Tuning
from gr_ros2.link.access import Access
from gr_ros2.link.air import Air
from gr_ros2.link.v1.repair import RepairMode
from gr_ros2.settings.commands import COMMAND_TYPES
from gr_ros2.settings.config import NOBODY
from gr_ros2.settings.fields import AUTO, Auto
from gr_ros2.settings.robot import RobotConfig
from gr_ros2.wire.v1 import BROADCAST, HEADER_LEN, REPAIR_HEADER_LEN, TAG_LEN

MIN_PACKET_LEN = HEADER_LEN + REPAIR_HEADER_LEN + TAG_LEN + 26


@dataclass(frozen=True, slots=True)
class Settings:
    """One robot's end of a link.

    :param src_id: 0..254; ``NOBODY`` at an end that only receives. Such an end takes packets for any robot
    :param packet_len: bytes of the longest packet, the same at all ends
    :param any_length: packets have only as many bytes as they need; otherwise every one has ``packet_len``
    :param dst_id: id of the robot that packets are for, 255 = all robots
    :param repair: what idle slots carry; auto takes ``thrifty`` where reports come and ``idle`` where none do
    :param expected_loss: share of packets that are lost, used until a report gives it
    :param hears: whether this end receives too, and reports what it hears
    :param half_duplex: whether sending and receiving share the airtime, so that reports take it from the other end
    :param access: decides when packets may leave on a channel that others share; None: whenever there is a credit
    :param relay: whether messages of other robots are sent on
    :param radios: over how many radios packets come; those of several overtake each other
    :param hold_s: s that a complete message of a reliable topic waits for an earlier one whose sender gets no reports
    :param max_age_s: s for which a sealed message may have been withheld before it is refused; auto:
        ``MAX_AGE_S`` or, over other robots, a longer deadline, for calls and topics with a deadline or lifespan, no
        bound for others; 0 = no bound
    :param max_ages: the same by topic; * and ? in its name stand for others
    :param repeat_s: s between repeats of latched messages while no robot reports; 0 = no repeats
    :param max_source_bytes: memory for packets and incomplete messages, per robot heard
    :param max_sources: robots heard at a time
    :param packet_rate: packets/s at most; auto = as many as credits allow, where credits are given; 0 = no limit
    :param queue_depth: messages that may wait per topic; 0 = no limit
    :param commands: types and names of topics that it sends whose messages come in time or not at all
    :param deadlines: s by topic likewise, after which a message is not delivered any more, whatever its
        sender says; 0 = any time
    :param airtime_share: part of the time that this robot may send, above 0..1
    :param packet_s: tells s from one packet of this robot to its next, where nobody shares its channel and it always
        has one; 0 = not known
    :param beacon_s: s without hearing any robot after which one hello leaves every so many s, and nothing else; 0 = off
    :param tuning: the constants that were found by measurement
    """

    src_id: int
    packet_len: int = 220
    any_length: bool = False
    dst_id: int = BROADCAST
    repair: RepairMode | Auto = AUTO
    expected_loss: float = 0.2
    hears: bool = True
    half_duplex: bool = False
    access: Access | None = field(default=None, compare=False)
    relay: bool = False
    radios: int = 1
    hold_s: float = 1.0
    max_age_s: float | Auto = AUTO
    max_ages: Mapping[str, float] = field(default_factory=dict)
    repeat_s: float = 10.0
    max_source_bytes: int = 72_000_000
    max_sources: int = 16
    packet_rate: float | Auto = AUTO
    queue_depth: int = 100
    commands: tuple[str, ...] = COMMAND_TYPES
    deadlines: Mapping[str, float] = field(default_factory=dict)
    airtime_share: float = 1.0
    packet_s: Callable[[], float] = field(default=lambda: 0.0, compare=False)
    beacon_s: float = 0.0
    tuning: Tuning = Tuning()

    def __post_init__(self) -> None:
        if not MIN_PACKET_LEN <= self.packet_len <= 4095:
            raise ConfigError(f"packet_len = {self.packet_len}: version 1 needs {MIN_PACKET_LEN}..4095")
        if not 0 <= self.src_id < BROADCAST and (self.hears or self.src_id != NOBODY):
            raise ConfigError(f"robot_id = {self.src_id}: must be 0..254")
        if self.beacon_s and not self.hears:
            raise ConfigError(
                f"beacon_s = {self.beacon_s:g}: this end never hears anybody, so it would fall silent for ever; set 0, "
                "or run a link both ways"
            )

    @property
    def shares(self) -> bool:
        """Whether others send on the same channel: reports are few then."""
        return self.access is not None

    def turn_s(self) -> float:
        """s from one packet of this robot to its next, where it always has one; 0 = not known."""
        return self.packet_s() if self.access is None else self.access.turn_s

    @property
    def slower(self) -> float:
        """By how much longer than written rules wait for packets of others, and by how much more rarely a robot speaks
        of itself: turns come less often on a slow channel, on one that many share, and with a limit of airtime."""
        return max(1.0, self.turn_s() / self.tuning.turn_s) / self.airtime_share

    @property
    def turns_are_rare(self) -> bool:
        """Whether this robot's turns on a channel that others share are rare."""
        return self.shares and self.slower > 1

    @property
    def idle_is_free(self) -> bool:
        """Whether a packet in a slot that would be idle takes airtime from nobody."""
        return self.airtime_share == 1 and not (self.half_duplex or self.shares)


def end_settings(robot: RobotConfig, air: Air, *, loops_back: bool = False, tuning: Tuning = Tuning()) -> Settings:
    """The settings of a robot's end.

    :param loops_back: whether it receives what it sends itself, and takes packets of and for any robot
    :raises ConfigError: for settings that contradict each other
    """
    taken = robot.publish.topics.items()
    return Settings(
        src_id=NOBODY if loops_back else robot.robot_id,
        packet_len=robot.packet_len,
        any_length=air.any_length,
        repair=robot.repair,
        expected_loss=robot.expected_loss,
        hears=air.hears,
        half_duplex=air.half_duplex,
        access=air.access(robot.robot_id),
        relay=air.relay,
        radios=air.radios,
        hold_s=robot.hold_s,
        max_age_s=robot.max_age_s,
        max_ages={name: options.max_age_s for name, options in taken if options.max_age_s != AUTO},
        repeat_s=robot.repeat_s,
        max_source_bytes=robot.max_source_bytes,
        max_sources=robot.max_sources,
        packet_rate=robot.packet_rate,
        queue_depth=robot.queue_depth,
        commands=robot.commands,
        deadlines={name: options.deadline_s for name, options in taken if options.deadline_s != AUTO},
        airtime_share=air.airtime_share,
        packet_s=lambda: air.airtime_s,
        beacon_s=robot.beacon_s,
        tuning=tuning,
    )
