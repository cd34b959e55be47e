"""The settings of an endpoint of version 1, about itself and its radio.

Invariant: this module holds values only; every default suits a radio of some kB/s between two robots.
"""

from __future__ import annotations

from dataclasses import dataclass

from gr_ros2.core.errors import ConfigError
from gr_ros2.link.v1.repair import RepairMode
from gr_ros2.settings.config import SinkConfig, SourceConfig
from gr_ros2.settings.fields import AUTO, Auto
from gr_ros2.wire.v1 import BROADCAST, HEADER_LEN, STANDING_LEN, TAG_LEN

NOBODY = -1
MIN_PACKET_LEN = HEADER_LEN + STANDING_LEN + TAG_LEN + 26


@dataclass(frozen=True, slots=True)
class Settings:
    """One robot's end of a link.

    :param src_id: 0..254; ``NOBODY`` at an end that only receives. Such an end takes packets for any robot
    :param packet_len: bytes of the longest packet, the same at all ends
    :param fixed: every packet has ``packet_len`` bytes; otherwise only as many as it needs
    :param dst_id: id of the robot that packets are for, 255 = all robots
    :param repair: what idle slots carry; auto takes ``thrifty`` where reports come and ``idle`` where none do
    :param expected_loss: share of packets that are lost, used until a report gives it
    :param hears: whether this end receives too, and reports what it hears
    :param half_duplex: whether sending and receiving share the airtime, so that reports take it from the other end
    :param hold_s: s that a complete message of a reliable topic waits for an earlier one whose sender gets no reports
    :param max_age_s: s for which a sealed message may have been withheld before it is refused; auto: 15 for calls and
        topics with a deadline or lifespan, no bound for others; 0 = no bound
    :param repeat_s: s between repeats of latched messages while no robot reports; 0 = no repeats
    :param max_source_bytes: memory for packets and incomplete messages, per robot heard
    :param max_sources: robots heard at a time
    :param packet_rate: packets/s at most; auto = as many as credits allow, where credits are given; 0 = no limit
    :param queue_depth: messages that may wait per topic; 0 = no limit
    """

    src_id: int
    packet_len: int = 220
    fixed: bool = True
    dst_id: int = BROADCAST
    repair: RepairMode | Auto = AUTO
    expected_loss: float = 0.2
    hears: bool = True
    half_duplex: bool = False
    hold_s: float = 1.0
    max_age_s: float | Auto = AUTO
    repeat_s: float = 10.0
    max_source_bytes: int = 72_000_000
    max_sources: int = 16
    packet_rate: float | Auto = AUTO
    queue_depth: int = 100

    def __post_init__(self) -> None:
        if not MIN_PACKET_LEN <= self.packet_len <= 4095:
            raise ConfigError(f"packet_len = {self.packet_len}: version 1 needs {MIN_PACKET_LEN}..4095")
        if not 0 <= self.src_id < BROADCAST and (self.hears or self.src_id != NOBODY):
            raise ConfigError(f"robot_id = {self.src_id}: must be 0..254")


def robot_of(source: SourceConfig | None, sink: SinkConfig | None) -> int:
    """Id of the robot that an end belongs to; ``NOBODY`` for an end that only receives and has none.

    :raises ConfigError: when the source names no robot
    """
    if source is not None:
        return source.src_id()
    return NOBODY if sink is None or sink.robot_id == AUTO else sink.robot_id


def settings_of(
    source: SourceConfig | None, sink: SinkConfig | None, *, hears: bool, half_duplex: bool = False, fixed: bool = True
) -> Settings:
    """The settings of an end, made from those of its blocks.

    :param hears: whether it receives and can report
    :param fixed: whether every packet must be as long as the longest
    :raises ConfigError: neither block names the robot, although it would send something
    """
    send = SourceConfig() if source is None else source
    take = SinkConfig() if sink is None else sink
    return Settings(
        src_id=robot_of(source, sink),
        packet_len=take.packet_len if source is None else source.packet_len,
        fixed=fixed,
        dst_id=send.dst_id,
        repair=send.repair,
        expected_loss=send.expected_loss,
        hears=hears,
        half_duplex=half_duplex,
        hold_s=take.hold_s,
        max_age_s=take.max_age_s,
        repeat_s=send.repeat_s,
        max_source_bytes=take.max_source_bytes,
        max_sources=take.max_sources,
        packet_rate=send.packet_rate,
        queue_depth=send.queue_depth,
    )
