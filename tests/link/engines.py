"""What tests of the engines share."""

from __future__ import annotations

import random
from typing import Any

from gr_ros2.link import AirPacket, Delivered, Received, ReceiverEvent
from gr_ros2.paper.receiver import MAX_BYTES, Receiver
from gr_ros2.paper.sender import Sender
from gr_ros2.paper.settings import paper_from
from gr_ros2.settings.config import NOBODY
from gr_ros2.settings.registry import Registry
from gr_ros2.wire.v0 import V0, PacketV0
from tests.packets import data_of


def registry(topics: int = 3) -> Registry:
    names = {f"t{number}": "std_msgs/String" for number in range(topics)}
    return Registry.from_rows(names)


def sender(rows: int = 3, seed: int = 0, **settings: Any) -> Sender:
    return Sender(registry(rows), *paper_from(**{"robot": 1, **settings}), rng=random.Random(seed))


def receiver(rows: int = 3, max_bytes: int = MAX_BYTES, **settings: Any) -> Receiver:
    own = None if "robot" in settings else NOBODY
    return Receiver(registry(rows), *paper_from(**{"robot": 0, **settings}), own=own, max_bytes=max_bytes)


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
