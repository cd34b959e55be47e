"""The receiver decodes what came whole, and books what it cannot read under the codec's row."""

from __future__ import annotations

import pytest

from gr_ros2.compression import LinkCodec
from gr_ros2.link import AirPacket, Delivered, Lost, Received, ReceiverEvent
from gr_ros2.paper.receiver import Receiver
from gr_ros2.paper.settings import paper_from
from gr_ros2.settings.registry import Registry
from gr_ros2.wire.v0 import V0, EntryV0, PacketV0
from tests.compression.support import simulated

REGISTRY = Registry.from_rows({"odom": "nav_msgs/Odometry"})
PACKET_LEN = 220


def received(coded: bytes, *, codec: LinkCodec | None, compressed: bool = True) -> list[ReceiverEvent]:
    receiver = Receiver(REGISTRY, *paper_from(robot=0, packet_len=PACKET_LEN), codec=codec)
    pieces = [coded[at : at + 100] for at in range(0, len(coded), 100)]
    events: list[ReceiverEvent] = []
    for n, piece in enumerate(pieces):
        packet = PacketV0(1, 255, n, 1, (EntryV0(0, 7, n, len(pieces), piece),), compressed=compressed)
        events += receiver.receive(AirPacket(V0.encode(packet, PACKET_LEN)), 0.0)
    lost = [key for key, count in receiver.stats.lost.items() if count == 1]
    assert lost == [(event.src_id, event.topic_id, event.reason) for event in events if isinstance(event, Lost)]
    return [event for event in events if not isinstance(event, Received)]


def test_a_compressed_message_is_delivered_as_it_was() -> None:
    payload = simulated("odom", 0.2)[0]
    codec = LinkCodec(REGISTRY)
    assert received(codec.encode(0, payload), codec=codec) == [Delivered(1, 0, payload, 0, 7)]
    assert received(b"\0" + payload, codec=codec) == [Delivered(1, 0, payload, 0, 7)]
    assert received(payload, codec=codec, compressed=False) == [Delivered(1, 0, payload, 0, 7)]


@pytest.mark.parametrize(
    ("coded", "fate"),
    [
        (b"\xf2abc", "unknown_dictionary"),
        (b"\x05abc", "unsupported"),
        (b"\x01abc", "damaged"),
        (b"\x12\xff" * 40, "damaged"),
    ],
)
def test_what_cannot_be_read_has_a_fate(coded: bytes, fate: str) -> None:
    assert received(coded, codec=LinkCodec(REGISTRY)) == [Lost(1, 0, fate, 7)]


def test_without_a_codec_it_is_unsupported() -> None:
    assert received(b"\0abc", codec=None) == [Lost(1, 0, "unsupported", 7)]
