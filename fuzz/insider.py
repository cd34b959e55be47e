"""What a robot that has the key can send, or anybody where there is none: packets with right trailers and any content.
The endpoint never raises, its memory is bounded, and so is the work per packet.

An input is a script that is read byte by byte: who sends, what kind of packet, and which fields. So mutations change
fields of valid packets, not bytes under a trailer.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, TypeVar, cast

from fuzz.loop import main, work
from gr_ros2.link import AirPacket
from gr_ros2.link.events import Delivered, ReceiverEvent, SentPacket
from gr_ros2.link.key import Key
from gr_ros2.link.v1.endpoint import EndpointV1
from gr_ros2.link.v1.endpoint_settings import Settings
from gr_ros2.link.v1.gf256 import combine
from gr_ros2.link.v1.sealing import NOT_A_REPAIR, Keys, SealMode
from gr_ros2.mac import Slots
from gr_ros2.settings.config import SendOptions
from gr_ros2.settings.registry import Registry, Topic
from gr_ros2.wire import v1
from gr_ros2.wire.control import ENCRYPTS, About, Ask, Control, Heard, Hello, LeftOut, Newest, Ping, Report, Waited
from gr_ros2.wire.mac_block import MAP_SLOTS, Block, write_block
from gr_ros2.wire.relayed import MOST_HOPS, PLACES, Receipt, Relayed, write_carried, write_receipts, write_relayed
from gr_ros2.wire.table import AnnouncedTopic, write_table

PACKET_LEN = 128
MOST_LINES = 30_000
"""Lines of Python that one packet and the answer to it may take."""
MOST_PACKETS = 120
_SLOT_S = 0.02
_OWN, _BOOT = 9, 7 << 32 | 70
_KEY = bytes(range(32))
_MODES: tuple[SealMode, ...] = ("none", "authenticate", "encrypt")
_WAITS_S = (0.0, 0.001, 0.001, *[0.02] * 20, 0.1, 0.1, 0.6, 2.0, 11.0)
_ROBOTS = (1, 2, 3, 0, 254)
STARTS = (
    *[(1, 1 << 32 | 11)] * 10,
    *[(2, 1 << 32 | 12)] * 4,
    (1, 2 << 32 | 22),
    (3, 13),
    (0, 1),
    (254, (1 << 64) - 1),
)
_TOPICS = (0, 1, 2, 3, 239, v1.TABLE_TOPIC, v1.RELAYED_TOPIC, v1.CARRIED_TOPIC)
_NUMBERS = (0, 1, 2, 63, 64, 127, 128, 1000, 0x7FFF, 0x8000, 0xFFFF)
_STEPS = (*[1] * 24, 2, 2, 3, 65, 128, 600, 30_000, 0x8001)
_ROWS = [
    AnnouncedTopic(0, "a", "std_msgs/msg/String", 0, True),
    AnnouncedTopic(1, "b", "std_msgs/msg/String", 1, False, True),
    AnnouncedTopic(2, "c", "std_msgs/msg/String", 2, True, False, 1, "", True, _OWN, 30),
]
_T = TypeVar("_T")


class Script:
    """Choices read from bytes; zeros after their end."""

    def __init__(self, data: bytes) -> None:
        self._data, self._at = data, 0

    @property
    def over(self) -> bool:
        return self._at >= len(self._data)

    def byte(self) -> int:
        self._at += 1
        return self._data[self._at - 1] if self._at <= len(self._data) else 0

    def pick(self, of: Sequence[_T]) -> _T:
        return of[self.byte() % len(of)]

    def number(self) -> int:
        return self.pick(_NUMBERS) if self.byte() & 1 else self.byte()

    def bytes(self, most: int) -> bytes:
        length = min(self.byte(), most)
        return bytes([self.byte() for _ in range(min(length, 8))]).ljust(length, b"x")


class Robot:
    """One start of one robot that says anything."""

    def __init__(self, src_id: int, boot: int, mode: SealMode, *, slots: bool, packet_len: int = PACKET_LEN) -> None:
        self.src_id, self.boot, self.number = src_id, boot, 0
        self._packet_len = packet_len
        self.repair_id = 0
        self._slots, self._encrypts, self._met = slots, mode == "encrypt", False
        keys = Keys((_KEY,) if mode != "none" else (), mode)
        self.sealed, self._trailer = keys.sealed, keys.own(src_id, boot)
        self._trailer_len = keys.trailer_len
        self.bodies: dict[int, bytes] = {}

    def packet(self, script: Script, echo: bytes) -> bytes:
        """The next packet."""
        kind = script.byte() % 16 if self._met else 0
        self._met = True
        to = script.pick((*[v1.BROADCAST] * 28, _OWN, _OWN, _OWN, 1))
        block = _block(script) if self._slots ^ (script.byte() % 32 == 0) else b""
        qos = v1.QOS_REPAIR if kind < 8 else script.byte() % 3
        if kind >= 8:
            self.number += script.pick(_STEPS)
        header = v1.Header(qos, self.sealed, self.src_id, self.number & 0xFFFF, to, script.byte() % 3, block)
        clear, room = v1.write_header(header), header.room(self._packet_len)
        if kind >= 8:
            body = self._fitting(self.parts(script, room), room)
            self.bodies[self.number] = body
            return self._trailer.close(clear, body, self.number, NOT_A_REPAIR)
        self.repair_id = (self.repair_id + script.pick((*[1] * 6, 0, 7))) % v1.REPAIR_IDS
        oldest = script.byte() & 1 > 0
        if kind < 2:
            hello = Hello(
                self.boot,
                self.number >> 16,
                (script.byte() | script.byte()) & 13 | self._encrypts * ENCRYPTS,
                script.number(),
                tuple([(script.pick(_TOPICS), script.byte()) for _ in range(script.byte() % 3)]),
            )
            body = self._fitting([hello, Heard(_OWN, echo, self.number & 0xFFFF)], room)
            repair = v1.RepairHeader(self.repair_id, 0, oldest, clear=True)
        elif kind < 6 and self.bodies:
            repair, body = self._combination(script, room, len(clear), oldest=oldest)
        else:
            body = self._fitting([self.control(script, echo) for _ in range(1 + script.byte() % 4)], room)
            repair = v1.RepairHeader(self.repair_id, 0, oldest)
        clear += v1.write_repair_header(repair)
        return self._trailer.close(clear, body, self.number, repair.repair_id, plain=repair.clear)

    def parts(self, script: Script, room: int) -> list[v1.EntryV1]:
        """What its next packet of messages carries."""
        return _parts(script, self, room)

    def _combination(self, script: Script, room: int, clear: int, *, oldest: bool) -> tuple[v1.RepairHeader, bytes]:
        """Of what it has sent, or of anything; also longer or shorter than its bodies.

        :param clear: bytes of the header
        """
        mask = 1
        for _ in range(script.byte() % 12):
            mask |= 1 << script.byte() % v1.MAX_WINDOW
        members = [self.number - back for back in range(mask.bit_length()) if mask >> back & 1]
        combined = combine([(n, self.bodies.get(n, b"")) for n in members if n >= 0], self.repair_id)
        if script.byte() % 4 == 0:
            combined = script.bytes(room)
        repair = v1.RepairHeader(self.repair_id, mask, oldest)
        most = self._packet_len - self._trailer_len - clear - len(v1.write_repair_header(repair))
        length = min(max(len(combined) + script.pick((0, 0, 0, 0, 1, 2, -1, most)), 0), most)
        return repair, combined[:length].ljust(length, b"\xff")

    def control(self, script: Script, echo: bytes) -> Control:
        """What it says of packets and of robots."""
        return _control(script, echo)

    @staticmethod
    def _fitting(entries: Sequence[v1.EntryV1], room: int) -> bytes:
        """As many of the entries as fit."""
        body = b""
        for entry in entries:
            more = v1.write_body([entry], v1.MAX_MESSAGE)
            if len(body) + len(more) > room:
                break
            body += more
        return body


def _block(script: Script) -> bytes:
    first, second = script.byte() % 127 + 1, script.byte() % 127 + 1
    names = script.byte(), script.byte()
    if script.byte() & 1:
        return write_block(Block(script.byte(), (first, second), script.byte() % 64, names))
    expected = int.from_bytes(bytes([script.byte() for _ in range(4)]), "big") & (1 << MAP_SLOTS) - 1
    conflict = script.byte() % 256, script.byte()
    return write_block(Block(script.byte(), (first, second), script.byte() % 64, names, expected, conflict))


def _control(script: Script, echo: bytes) -> Control:
    kinds: list[Callable[[], Control]] = [
        lambda: Ask(script.pick((_OWN, 1, 2)), bytes([script.pick(_TOPICS) for _ in range(1 + script.byte() % 4)])),
        lambda: Report(
            script.pick((_OWN, _OWN, 1)),
            script.pick((_BOOT & 0xFFFF, 1)),
            script.number(),
            script.number() | script.number() << 48,
            script.byte() & 1 > 0,
            script.byte() % 128,
            script.pick((None, -40.0, 12.5)),
        ),
        lambda: Heard(script.pick((_OWN, _OWN, 1)), script.pick((echo, bytes(4))), script.number()),
        lambda: Ping(
            script.pick((_OWN, 1)), script.number(), script.byte() & 1 > 0, script.byte() & 1 > 0, script.number(), 1, 2
        ),
        lambda: About(script.number(), 1, 2, script.bytes(20)),
        lambda: Newest(
            script.pick((*_ROBOTS, _OWN, _OWN)),
            script.pick((_BOOT & 0xFF, script.byte())),
            script.pick(_TOPICS),
            script.number(),
            script.pick((None, 0, 255)),
        ),
        lambda: Hello(script.byte(), script.byte(), script.byte(), script.byte()),
        lambda: LeftOut(script.number(), script.number() | script.number() << 48, script.byte() & 1 > 0),
        lambda: Waited(bytes([script.byte() for _ in range(1 + script.byte() % 4)])),
    ]
    return script.pick(kinds)()


def _parts(script: Script, robot: Robot, room: int) -> list[v1.EntryV1]:
    parts: list[v1.EntryV1] = []
    for _ in range(script.byte() % 4):
        topic_id = script.pick(_TOPICS)
        if topic_id == v1.TABLE_TOPIC:
            payload = _table(script)
        elif topic_id > v1.TABLE_TOPIC:
            payload = _of_another(script, robot, carried=topic_id == v1.CARRIED_TOPIC)
        else:
            payload = script.bytes(100)
        coded = script.byte() % 8 == 0
        if script.byte() % 4 or not payload:
            parts.append(v1.Part(topic_id, payload[: room - 3], coded=coded))
        else:
            offset, back = script.pick(((0, script.number()), (script.number(), script.number())))
            parts.append(v1.Part(topic_id, payload[:40], back, offset, script.byte() & 1 > 0, coded))
        if script.byte() % 4 == 0:
            parts.append(_control(script, b"echo"))
    return parts


def _table(script: Script) -> bytes:
    rows = [script.pick((row, row, AnnouncedTopic(row.topic_id, "", ""))) for row in _ROWS if script.byte() & 3]
    return write_table(rows) + script.bytes(3) * (script.byte() % 8 == 0)


def _of_another(script: Script, robot: Robot, *, carried: bool) -> bytes:
    origin = script.pick((robot.src_id, *_ROBOTS, _OWN))
    boot = script.pick((robot.boot, robot.boot, *[boot for _, boot in STARTS]))
    topic_id = script.pick(_TOPICS[:6])
    payload = script.bytes(30)
    if topic_id == v1.TABLE_TOPIC:
        payload = boot.to_bytes(8, "big") + _table(script)
        if carried:
            told = Receipt(boot & 0xFFFF, script.pick(_TOPICS[:5]), script.number(), 1)
            payload = write_receipts([told] * (script.byte() % 3))
    number = script.pick((script.number(), robot.number & 0xFFFF_FFFF, 2**32 - 1))
    hops = script.pick((1, 1, 1, 2, MOST_HOPS)) if origin != robot.src_id else script.pick((0, 0, 0, 1))
    to = script.pick((_OWN, 1, 3)) if carried else script.pick((v1.BROADCAST, v1.BROADCAST, _OWN, 1))
    message = Relayed(
        origin, boot & 0xFFFF, number, script.byte(), topic_id, hops, payload, script.byte() % 8 == 0, to, script.byte()
    )
    if not carried:
        return write_relayed(message)
    message = message._replace(limit=script.byte(), waits=script.byte() % PLACES)
    return write_carried(script.pick((_OWN, _OWN, 1)), message)


def insider(data: bytes) -> None:
    """A script: mode, whether it relays and has slots, then the packets."""
    script = Script(data)
    mode, relay = script.pick(_MODES), script.byte() % 4 > 0
    topics = Registry(
        [
            Topic(0, "state", "std_msgs/msg/String", SendOptions(queue="latest")),
            Topic(1, "map", "std_msgs/msg/String", SendOptions(durability="transient_local")),
            Topic(2, "goal", "std_msgs/msg/String", SendOptions(to=1)),
        ]
    )
    access = Slots(_OWN, _SLOT_S, random.Random(1), period_s=0.1) if relay or script.byte() & 1 else None
    common: dict[str, Any] = {"any_length": True, "max_sources": 3, "max_source_bytes": 16_384}
    settings = Settings(_OWN, packet_len=PACKET_LEN, access=access, relay=relay, **common)
    keys = Keys((_KEY,) if mode != "none" else (), mode)
    end = EndpointV1(topics, settings, boot=_BOOT, keys=keys, save=lambda *_: None)
    end.pace.use_credit()
    robots: dict[tuple[int, int], Robot] = {}
    now, echo = 0.0, bytes(4)
    latest: dict[tuple[int, int, int], tuple[int, int]] = {}
    for step in range(MOST_PACKETS):
        if script.over:
            break
        name = script.pick(STARTS)
        robot = robots.setdefault(name, Robot(*name, mode, slots=access is not None))
        data = robot.packet(script, echo)
        now += script.pick(_WAITS_S)
        if step % 8 == 0:
            end.messages.submit(step // 8 % 3, b"%d" % step * 20, now)
        lines, (events, sent) = work(partial(_take, end, data, now))
        assert lines < MOST_LINES, f"{lines} lines"
        for packet in sent:
            assert len(packet.data) <= PACKET_LEN
            repair = cast("v1.PacketV1", packet.packet).repair
            if repair is not None and repair.clear:
                echo = packet.data[-4:]
        check(end, events, latest)


def _take(end: EndpointV1, data: bytes, now: float) -> tuple[list[ReceiverEvent], list[SentPacket]]:
    """Receive a packet, and send what may leave."""
    events = end.receive(AirPacket(data, now), now) + end.handle_timeout(now)
    sent = []
    for _ in range(2):
        end.pace.credit()
        packet = end.next_packet(now)
        if packet is not None:
            sent.append(packet)
    end.next_timeout()
    end.next_departure(credited=True)
    return events, sent


def check(
    end: EndpointV1, events: Sequence[ReceiverEvent], latest: dict[tuple[int, int, int], tuple[int, int]]
) -> None:
    """Nothing is delivered after a later message of its topic, and memory is bounded."""
    for event in events:
        if isinstance(event, Delivered):
            assert isinstance(event.key, Key)
            name, order = (event.src_id, event.topic_id, event.key.boot), (event.key.number, event.key.place)
            assert order > latest.get(name, (-1, -1)), f"{event} after {latest[name]}"
            latest[name] = order
    assert len(end.neighbours.all) <= end.settings.max_sources
    for neighbour in end.neighbours.all.values():
        assert neighbour.inbox.held <= end.settings.max_source_bytes


def corpus() -> list[bytes]:
    """Scripts of all kinds of packets in turn, and of one kind."""
    rng = random.Random(5)
    found = [b"", bytes(200)]
    for mode in range(3):
        for _ in range(6):
            found.append(bytes((mode,)) + rng.randbytes(2000))
    return found


if __name__ == "__main__":
    main(insider, corpus())
