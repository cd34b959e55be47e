"""What tests of the engines share."""

from __future__ import annotations

import random
from typing import Any

from gr_ros2.link import AirPacket, Delivered, Received, ReceiverEvent
from gr_ros2.link.v0.receiver import Receiver
from gr_ros2.link.v0.sender import Sender
from gr_ros2.settings.config import SinkConfig, SourceConfig, build
from gr_ros2.settings.registry import Registry
from gr_ros2.wire.v0 import V0, PacketV0
from tests.packets import data_of


def registry(topics: int = 3) -> Registry:
    names = {f"t{number}": "std_msgs/String" for number in range(topics)}
    return Registry.from_rows(names)


def sender(topics: int = 3, seed: int = 0, **settings: Any) -> Sender:
    config = build(SourceConfig, {"robot_id": 1, "version": 0, **settings})
    return Sender(registry(topics), config, rng=random.Random(seed))


def receiver(topics: int = 3, **settings: Any) -> Receiver:
    return Receiver(registry(topics), build(SinkConfig, {"version": 0, **settings}))


def drain(engine: Sender, now: float = 0.0) -> list[bytes]:
    """All packets that may leave at ``now``."""
    packets = []
    while (data := data_of(engine.next_packet(now))) is not None:
        packets.append(data)
    return packets


def trace(packets: list[bytes]) -> list[list[tuple[int, int, int]]]:
    """Per packet its entries as (topic_id, index, total)."""
    return [[(e.topic_id, e.index, e.total) for e in read(data).entries] for data in packets]


def read(data: bytes) -> PacketV0:
    return V0.decode(data, len(data))


def take(engine: Receiver, data: bytes, now: float) -> list[ReceiverEvent]:
    """What comes of a packet, beside that it came."""
    return [event for event in engine.receive(AirPacket(data), now) if not isinstance(event, Received)]


def delivered(events: list[ReceiverEvent]) -> list[bytes]:
    return [event.payload for event in events if isinstance(event, Delivered)]
