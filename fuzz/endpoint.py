"""An endpoint of version 1: whatever packets come, in whatever order and time, it never raises, its memory is bounded,
and no packet takes it long."""

from __future__ import annotations

import random
import time
from collections.abc import Iterator

from fuzz.loop import main
from gr_ros2.link.events import Delivered
from gr_ros2.link.v1.endpoint import Endpoint
from gr_ros2.link.v1.endpoint_settings import Settings
from gr_ros2.registry import Registry
from gr_ros2.wire import v1

PACKET_LEN = 64
SLOWEST_S = 1.0
"""s of processor time that one packet may take: a bound that means "for ever", not a target."""
_STEP = PACKET_LEN - v1.CRC_LEN + 1
_WAITS_S = (0.0, 0.0, 0.001, 0.03, 0.6, 2.0, 70.0, 1e6)
_BOOTS = (11, 22)
_TOPICS = Registry.from_rows({"a": "std_msgs/String", "map": "std_msgs/String", "c": "std_msgs/String"})
_SETTINGS = Settings(9, packet_len=PACKET_LEN, max_sources=3, max_source_bytes=8192)


def endpoint(data: bytes) -> None:
    """A script of packets: each a byte that says how long to wait and whether the CRC is right, then its bytes."""
    end = Endpoint(_TOPICS, _SETTINGS, boot=7)
    end.use_credit()
    now = 0.0
    latest: dict[tuple[int, int, int], tuple[int, int]] = {}
    for wait, boot, body in steps(data):
        now += wait
        packet = body + (b"\0" * 4 if boot is None else v1.crc(body, v1.session_crc(boot, 0)))
        begin = time.process_time()
        events = end.receive(packet, now)
        events += end.handle_timeout(now)
        end.credit()
        answer = end.next_packet(now)
        assert time.process_time() - begin < SLOWEST_S
        assert answer is None or len(answer) == PACKET_LEN
        end.next_timeout()
        for event in events:
            if isinstance(event, Delivered):
                name, order = (event.src_id, event.topic_id, event.key.boot), (event.key.number, event.key.place)
                assert order > latest.get(name, (-1, -1))
                latest[name] = order
        assert len(end.neighbours) <= _SETTINGS.max_sources
        for neighbour in end.neighbours:
            assert neighbour.inbox.held <= _SETTINGS.max_source_bytes


def steps(data: bytes) -> Iterator[tuple[float, int | None, bytes]]:
    for start in range(0, len(data), _STEP):
        head, body = data[start], data[start + 1 : start + _STEP]
        yield _WAITS_S[head & 7], None if head >= 240 else _BOOTS[head >> 3 & 1], body


def corpus() -> list[bytes]:
    """Scripts of what real senders send, undisturbed, shuffled, thinned and mixed."""
    rng = random.Random(2)
    scripts = []
    for robot_id, boot in ((1, 11), (2, 22), (9, 11)):
        sender = Endpoint(_TOPICS, Settings(robot_id, packet_len=PACKET_LEN, packet_rate=75), boot=boot)
        packets = []
        for number in range(60):
            if number % 3 == 0:
                sender.submit(number // 3 % 3, rng.randbytes(rng.choice((4, 30, 100))), number / 75)
            packet = sender.next_packet(number / 75)
            if packet is not None:
                head = rng.choice((0, 1, 2, 3)) | (8 if boot == 22 else 0)
                packets.append(bytes((head,)) + packet[: -v1.CRC_LEN])
        scripts.append(packets)
    shuffled = rng.sample(scripts[0], len(scripts[0]))
    thinned = [packet for packet in scripts[1] if rng.random() < 0.7]
    mixed = [packet for pair in zip(scripts[0], scripts[1], strict=False) for packet in pair]
    return [b"".join(packets) for packets in (*scripts, shuffled, thinned, mixed, scripts[0] * 2, [])]


if __name__ == "__main__":
    main(endpoint, corpus())
