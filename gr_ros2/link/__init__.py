"""The link engines: messages to packets and back. No IO, no clock, no threads; ``now`` is seconds, monotonic."""

from __future__ import annotations

from gr_ros2.link.endpoint import Endpoint, EndpointV0
from gr_ros2.link.events import (
    Accepted,
    Delivered,
    Lost,
    Missed,
    PacketId,
    Received,
    ReceivedPacket,
    ReceiverEvent,
    Refused,
    Rejected,
    SenderEvent,
    SentEntry,
    SentPacket,
)
from gr_ros2.link.receiver import Receiver
from gr_ros2.link.sender import Sender
from gr_ros2.link.stats import ReceiverStats, SenderStats

__all__ = [
    "Accepted",
    "Delivered",
    "Endpoint",
    "EndpointV0",
    "Lost",
    "Missed",
    "PacketId",
    "Received",
    "ReceivedPacket",
    "Receiver",
    "ReceiverEvent",
    "ReceiverStats",
    "Refused",
    "Rejected",
    "Sender",
    "SenderEvent",
    "SenderStats",
    "SentEntry",
    "SentPacket",
]
