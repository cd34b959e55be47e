"""The receiving engine: whatever packets come, in whatever order and time, it never raises and its books balance."""

from __future__ import annotations

import random
from collections.abc import Iterator
from functools import partial

from fuzz.loop import main, within
from gr_ros2.link import AirPacket, Delivered, Lost, ReceiverEvent, Rejected
from gr_ros2.paper.receiver import Receiver
from gr_ros2.paper.sender import Sender
from gr_ros2.paper.settings import paper_from
from gr_ros2.settings.registry import Registry
from gr_ros2.wire.v0 import with_crc, without_crc

PACKET_LEN = 40
_BODY_LEN = len(without_crc(bytes(PACKET_LEN)))
BASE, PER_BYTE = 500, 20
"""Lines of Python that a script may take, and more for each byte of it."""
_STEP = 1 + _BODY_LEN
_WAITS_S = (0.0, 0.0, 0.001, 0.03, 0.6, 2.0, 70.0, 1e6)
_REGISTRY = Registry.from_rows({"a": "std_msgs/String", "map": "std_msgs/String", "c": "std_msgs/String"})
_CONFIG = paper_from(packet_len=PACKET_LEN, max_sources=3, max_source_bytes=4096, robot=9)
_MAX_BYTES = 8192


def receiver(data: bytes) -> None:
    """A script of packets: each a byte that says how long to wait and whether the CRC is right, then its bytes."""
    within(BASE + PER_BYTE * len(data), partial(_hear, data))


def _hear(data: bytes) -> None:
    engine = Receiver(_REGISTRY, *_CONFIG, max_bytes=_MAX_BYTES)
    events: list[ReceiverEvent] = []
    now = 0.0
    given = 0
    for wait, intact, body in steps(data):
        now += wait
        packet = with_crc(body) if intact else body + b"\0\0"
        events += engine.receive(AirPacket(packet), now)
        given += 1
        assert engine.held_bytes <= _MAX_BYTES
        timeout = engine.next_timeout()
        assert (timeout is None) == (engine.held_bytes == 0)
    events += engine.handle_timeout(now + 2 * _CONFIG[1].reassembly_timeout_s)
    stats = engine.stats
    assert engine.held_bytes == 0
    assert engine.next_timeout() is None
    assert stats.packets + sum(stats.rejected.values()) == given
    assert sum(stats.delivered.values()) == sum(isinstance(event, Delivered) for event in events)
    assert sum(stats.lost.values()) == sum(isinstance(event, Lost) for event in events)
    assert sum(stats.rejected.values()) == sum(isinstance(event, Rejected) for event in events)
    assert min(stats.packet_loss_est, stats.message_loss_est, stats.repeats) >= 0


def steps(data: bytes) -> Iterator[tuple[float, bool, bytes]]:
    for start in range(0, len(data), _STEP):
        head, body = data[start], data[start + 1 : start + _STEP]
        yield _WAITS_S[head & 7], head < 224, body


def corpus() -> list[bytes]:
    """Scripts of what real senders send, undisturbed, shuffled, thinned and mixed."""
    rng = random.Random(2)
    scripts = []
    for robot_id in (1, 2, 9):
        sender = Sender(_REGISTRY, *paper_from(robot=robot_id, packet_len=PACKET_LEN), rng=random.Random(robot_id))
        for number in range(30):
            sender.submit(number % 3, rng.randbytes(rng.choice((4, 30, 100))), 0.0)
        packets = []
        while (sent := sender.next_packet(0.0)) is not None:
            packets.append(bytes([rng.randrange(4)]) + without_crc(sent.data))
        scripts.append(packets)
    shuffled = rng.sample(scripts[0], len(scripts[0]))
    thinned = [packet for packet in scripts[1] if rng.random() < 0.7]
    mixed = [packet for pair in zip(scripts[0], scripts[1], strict=False) for packet in pair]
    return [b"".join(packets) for packets in (*scripts, shuffled, thinned, mixed, scripts[0] * 2, [])]


if __name__ == "__main__":
    main(receiver, corpus())
