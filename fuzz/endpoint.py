"""An endpoint of version 1: whatever packets come, in whatever order and time, it never raises, its memory is bounded,
and the work per packet is bounded, also where a packet is a hello of any turns or jumps over numbers."""

from __future__ import annotations

import random
from collections.abc import Iterator

from fuzz.loop import main, work
from gr_ros2.core.errors import WireError
from gr_ros2.link import AirPacket
from gr_ros2.link.events import Delivered, ReceiverEvent
from gr_ros2.link.key import Key
from gr_ros2.link.v1.endpoint import EndpointV1
from gr_ros2.link.v1.endpoint_settings import Settings
from gr_ros2.settings.registry import Registry
from gr_ros2.wire import v1
from gr_ros2.wire.control import Hello

PACKET_LEN = 64
MOST_LINES = 20_000
"""Lines of Python that one packet may take. The equations and packets that these settings let a receiver hold explain
some thousands; what follows the numbers in a packet takes millions."""
_STEP = PACKET_LEN - v1.CRC_LEN + 1
_WAITS_S = (0.0, 0.0, 0.001, 0.03, 0.6, 2.0, 70.0, 1e6)
_BOOTS = (11, 22)
_TOPICS = Registry.from_rows({"a": "std_msgs/String", "map": "std_msgs/String", "c": "std_msgs/String"})
_SETTINGS = Settings(9, packet_len=PACKET_LEN, max_sources=3, max_source_bytes=8192)


def endpoint(data: bytes) -> None:
    """A script of packets: each a byte that says how long to wait and whether the CRC is right, then its bytes."""
    end = EndpointV1(_TOPICS, _SETTINGS, boot=7)
    end.pace.use_credit()
    now = 0.0
    latest: dict[tuple[int, int, int], tuple[int, int]] = {}
    for wait, boot, body in steps(data):
        now += wait
        packet = body + (b"\0" * 4 if boot is None else v1.crc(body, v1.session_crc(boot, _turns(end, body))))

        def take(packet: bytes = packet, now: float = now) -> tuple[list[ReceiverEvent], bytes | None]:
            events = end.receive(AirPacket(packet), now) + end.handle_timeout(now)
            end.pace.credit()
            sent = end.next_packet(now)
            return events, None if sent is None else sent.data

        lines, (events, answer) = work(take)
        assert lines < MOST_LINES, f"{lines} lines"
        assert answer is None or len(answer) == PACKET_LEN
        end.next_timeout()
        for event in events:
            if isinstance(event, Delivered):
                assert isinstance(event.key, Key)
                name, order = (event.src_id, event.topic_id, event.key.boot), (event.key.number, event.key.place)
                assert order > latest.get(name, (-1, -1))
                latest[name] = order
        assert len(end.neighbours.all) <= _SETTINGS.max_sources
        for neighbour in end.neighbours.all.values():
            assert neighbour.inbox.held <= _SETTINGS.max_source_bytes


def _turns(end: EndpointV1, body: bytes) -> int:
    """How often the number of a forged packet has wrapped around: as its hello says, or as the receiver takes it."""
    try:
        header = v1.read_header(body + bytes(v1.CRC_LEN), PACKET_LEN)
        if header.qos == v1.QOS_REPAIR and (repair := v1.read_repair_header(body, header.size, len(body))).clear:
            entries = v1.read_body(body[header.size + repair.size :], v1.body_room(PACKET_LEN))
            return next((entry.turns for entry in entries if isinstance(entry, Hello)), 0)
        neighbour = end.neighbours.all.get(header.src_id)
        return 0 if neighbour is None else neighbour.number(header.number) >> 16
    except WireError:
        return 0


def steps(data: bytes) -> Iterator[tuple[float, int | None, bytes]]:
    for start in range(0, len(data), _STEP):
        head, body = data[start], data[start + 1 : start + _STEP]
        yield _WAITS_S[head & 7], None if head >= 240 else _BOOTS[head >> 3 & 1], body


def corpus() -> list[bytes]:
    """Scripts of what real senders send, undisturbed, shuffled, thinned and mixed."""
    rng = random.Random(2)
    scripts = []
    for robot_id, boot in ((1, 11), (2, 22), (9, 11)):
        sender = EndpointV1(_TOPICS, Settings(robot_id, packet_len=PACKET_LEN, packet_rate=75), boot=boot)
        packets = []
        for number in range(60):
            if number % 3 == 0:
                sender.messages.submit(number // 3 % 3, rng.randbytes(rng.choice((4, 30, 100))), number / 75)
            sent = sender.next_packet(number / 75)
            if sent is not None:
                head = rng.choice((0, 1, 2, 3)) | (8 if boot == 22 else 0)
                packets.append(bytes((head,)) + sent.data[: -v1.CRC_LEN])
        scripts.append(packets)
    shuffled = rng.sample(scripts[0], len(scripts[0]))
    thinned = [packet for packet in scripts[1] if rng.random() < 0.7]
    mixed = [packet for pair in zip(scripts[0], scripts[1], strict=False) for packet in pair]
    return [b"".join(packets) for packets in (*scripts, shuffled, thinned, mixed, scripts[0] * 2, jumps(), [])]


def jumps() -> list[bytes]:
    """A sender of boot 11 that goes through all numbers that there are."""

    def packet(low: int, repair: v1.RepairHeader | None, *entries: v1.EntryV1) -> bytes:
        header = v1.Header(0 if repair is None else v1.QOS_REPAIR, False, 1, low & 0xFFFF)
        data = v1.write_header(header) + (b"" if repair is None else v1.write_repair_header(repair))
        return bytes((2,)) + (data + v1.write_body(entries, v1.body_room(PACKET_LEN))).ljust(_STEP - 1, b"\0")

    far = [
        packet(7, v1.RepairHeader(3, clear=True), Hello(11, turns, 1, 0))
        for turns in (0, 0xFFFF, 0xFFFF_FFFE, 0xFFFF_FFFF)
    ]
    steps = [packet(number * 32_000, None) for number in range(1, 20)]
    chain = [packet(number, v1.RepairHeader(number % 128, 3)) for number in range(20, 300)]
    return [far[0], *steps, *chain, packet(300, None), *far, *steps]


if __name__ == "__main__":
    main(endpoint, corpus())
