"""The link engines: messages to packets and back. No IO, no clock, no threads; ``now`` is seconds, monotonic."""

from __future__ import annotations

from gr_ros2.link.endpoint import Endpoint
from gr_ros2.link.events import (
    Accepted,
    AirPacket,
    Delivered,
    Ended,
    Lost,
    Missed,
    PacketId,
    Received,
    ReceiverEvent,
    Refused,
    Rejected,
    SenderEvent,
    SentEntry,
    SentPacket,
)
from gr_ros2.link.stats import ReceiverStats, SenderStats

__all__ = [
    "Accepted",
    "AirPacket",
    "Delivered",
    "Ended",
    "Endpoint",
    "Lost",
    "Missed",
    "PacketId",
    "Received",
    "ReceiverEvent",
    "ReceiverStats",
    "Refused",
    "Rejected",
    "SenderEvent",
    "SenderStats",
    "SentEntry",
    "SentPacket",
]
