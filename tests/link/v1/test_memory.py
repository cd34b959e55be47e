"""What a robot keeps of others takes no more memory than is set, whatever mixture of packets they send."""

from __future__ import annotations

import gc
import random
import tracemalloc
from collections.abc import Callable, Sequence

import pytest

from gr_ros2.link import AirPacket
from gr_ros2.link.v1.endpoint import EndpointV1
from gr_ros2.link.v1.endpoint_settings import Settings
from gr_ros2.link.v1.order import Ready
from gr_ros2.link.v1.reassembly import Reassembly
from gr_ros2.link.v1.sealing import NOT_A_REPAIR, SealMode
from gr_ros2.wire import v1
from gr_ros2.wire.control import ENCRYPTS, Hello, LeftOut
from gr_ros2.wire.relayed import Relayed, write_carried, write_relayed
from gr_ros2.wire.table import AnnouncedTopic, write_table
from gr_ros2.wire.v1 import CARRIED_TOPIC, RELAYED_TOPIC, TABLE_TOPIC, Header, Part, RepairHeader
from tests.link.v1.air import keys

MOST = 1_000_000
OWN = 2
FACE = "\U0001f600"
"""A text with one takes four bytes for each letter."""
Packets = list[bytes]
Attack = Callable[["Attacker"], Packets]


class Attacker:
    """A robot with the key, where there is one, that says what makes others keep most."""

    def __init__(self, src_id: int, mode: SealMode, packet_len: int, rng: random.Random) -> None:
        self.src_id, self.boot, self._rng = src_id, 7 + src_id, rng
        self._keys, self._packet_len = keys(mode), packet_len
        self._trailer = self._keys.own(src_id, self.boot)
        self.room = packet_len - self._keys.trailer_len - Header(0, False, src_id, 0).size
        self._number = self._repair_id = self._made = 0
        self._capabilities = ENCRYPTS * (mode == "encrypt")

    def packet(self, number: int, entries: Sequence[v1.EntryV1]) -> bytes:
        """As full as a packet can be."""
        body = v1.write_body(entries, self.room).ljust(self.room, b"\0")
        return self._trailer.close(self._header(number), body, number, NOT_A_REPAIR)

    def _header(self, number: int, repair: RepairHeader | None = None) -> bytes:
        qos = 0 if repair is None else v1.QOS_REPAIR
        clear = v1.write_header(Header(qos, self._keys.sealed, self.src_id, number & 0xFFFF))
        return clear + (b"" if repair is None else v1.write_repair_header(repair))

    def _repair(self, body: bytes, mask: int = 0, *, clear: bool = False) -> bytes:
        self._repair_id = (self._repair_id + 1) % v1.REPAIR_IDS
        header = self._header(self._number, RepairHeader(self._repair_id, mask, clear=clear))
        body = body[: self._packet_len - len(header) - self._keys.trailer_len]
        return self._trailer.close(header, body, self._number, self._repair_id, plain=clear)

    def _fits(self, make: Callable[[int], v1.EntryV1], most: int = 1000) -> list[v1.EntryV1]:
        """As many entries as a packet holds."""
        entries: list[v1.EntryV1] = []
        size = 0
        for n in range(most):
            entry = make(n)
            size += len(v1.write_body([entry], v1.MAX_MESSAGE))
            if size > self.room:
                break
            entries.append(entry)
        return entries

    def _next(self, *entries: v1.EntryV1, after: int = 1) -> Packets:
        self._number += after
        return [self.packet(self._number, entries)]

    # ---- attacks

    def hello(self) -> Packets:
        body = v1.write_body([Hello(self.boot, self._number >> 16, self._capabilities, 1)], self.room)
        return [self._repair(body, clear=True)]

    def table(self) -> Packets:
        """Reliable topics, in rows as large as they can be where they fit."""
        topic_id = self._rng.randrange(240)
        long = FACE + "n" * min((self.room - 40) // 3, 250)
        name = long if self._rng.random() < 0.8 else f"topic{topic_id}"
        text = long if name is long else ""
        row = AnnouncedTopic(topic_id, name, text or "a/msg/B", 0, True, False, 255, text)
        return self._next(*self._fits(lambda _: Part(TABLE_TOPIC, write_table((row,))), 1))

    def waiting(self) -> Packets:
        """Messages behind a gap."""
        size = self._rng.choice((1, 1, 40))
        return self._next(*self._fits(lambda n: Part(n % 8, b"w" * size)), after=2)

    def unknown(self) -> Packets:
        return self._next(*self._fits(lambda _: Part(self._rng.randrange(200, 240), b"?")))

    def begun(self) -> Packets:
        """First fragments of messages that never end."""
        topics = iter(self._rng.sample(range(240), 240))
        return self._next(*self._fits(lambda _: Part(next(topics), b"b", 0, 0, False), 200))

    def grown(self) -> Packets:
        """Fragments of one byte, one after the other one."""
        self._made += 2
        return self._next(Part(9, b"g", self._number, self._made, False))

    def over_at_once(self) -> Packets:
        """Messages of two fragments whose topics nobody knows."""
        topic_id = self._rng.randrange(240)
        return self._next(Part(topic_id, b"a", 0, 0, False)) + self._next(Part(topic_id, b"b", 1, 1, True))

    def combination(self) -> Packets:
        """A repair that leads to nothing yet."""
        self._number += 40
        mask = 1 << 126 | self._rng.getrandbits(126) | 1
        return [self._repair(self._rng.randbytes(self.room), mask) for _ in range(3)]

    def left_out(self) -> Packets:
        self._number += 63
        told = LeftOut(self._number + 1 & 0xFFFF, 0, False)
        return [*self._next(Part(1, b"o")), self._repair(v1.write_body([told], 60))]


ATTACKS = (
    Attacker.table,
    Attacker.waiting,
    Attacker.unknown,
    Attacker.begun,
    Attacker.grown,
    Attacker.over_at_once,
    Attacker.combination,
    Attacker.left_out,
)


def most_used(end: EndpointV1, one: Attacker, runs: Sequence[tuple[Attack, int]]) -> float:
    """Memory that the packets of some runs of attacks take at most, as a share of what is set."""
    rng = random.Random(1)
    recorded: Packets = []
    now, worst = 0.0, 0.0
    gc.collect()
    tracemalloc.start()
    try:
        before = tracemalloc.get_traced_memory()[0]
        for attack, count in runs:
            recorded += one.hello()
            end.receive(AirPacket(recorded[-1]), now)
            for step in range(count):
                packets = attack(one)
                if step % 50 == 0:
                    recorded += packets
                    packets = [*packets, rng.choice(recorded), bytes((0, step % 256)) + rng.randbytes(40)]
                for data in packets:
                    now += 1e-4
                    end.receive(AirPacket(data), now)
                if step % 20 == 0:
                    used = tracemalloc.get_traced_memory()[0] - before - sum(map(len, recorded))
                    worst = max(worst, used / MOST)
    finally:
        tracemalloc.stop()
    return worst


@pytest.mark.parametrize(
    ("mode", "packet_len", "count", "seed"),
    [("encrypt", 80, 300, 1), ("none", 900, 100, 1), ("encrypt", 900, 100, 0)],
)
def test_no_mixture_of_packets_takes_more_than_is_set(mode: SealMode, packet_len: int, count: int, seed: int) -> None:
    rng = random.Random(seed)
    end = EndpointV1(None, Settings(OWN, packet_len, max_source_bytes=MOST), boot=1, keys=keys(mode))
    attacks = rng.sample(ATTACKS, len(ATTACKS))
    runs = [(attack, rng.choice((count // 4, count))) for attack in attacks * 2]
    assert most_used(end, Attacker(1, mode, packet_len, rng), runs) <= 1.0


def test_what_is_kept_of_robots_that_are_far_takes_as_much_as_one_robot() -> None:
    """One of them is known, and takes as much beside it."""
    rng = random.Random(0)
    settings = Settings(OWN, 200, max_source_bytes=MOST, relay=True)
    end = EndpointV1(None, settings, boot=1)
    relaying = end._receiving.relaying
    assert relaying is not None
    kinds = "table", "carried here", "carried on", "relayed"
    gc.collect()
    tracemalloc.start()
    try:
        before, worst = tracemalloc.get_traced_memory()[0], 0
        for step in range(3000):
            of = Relayed(
                100 + (step % 20 and rng.randrange(10)),
                7,
                step,
                rng.randrange(128, 256),
                rng.randrange(200),
                1,
                b"",
                age=0,
            )
            kind = "table" if step % 20 == 0 else rng.choice(kinds)
            if kind == "table":
                row = AnnouncedTopic(of.topic_id, "far", "std_msgs/msg/String", 0, rng.random() < 0.5)
                table = (7).to_bytes(8, "big") + write_table((row,))
                of = of._replace(topic_id=TABLE_TOPIC, payload=table)
            elif kind == "relayed":
                of = of._replace(after=(step - 1, 0) if rng.random() < 0.5 else None, payload=rng.randbytes(30))
            else:
                here = kind == "carried here"
                of = of._replace(dst_id=OWN if here else 50, waits=rng.randrange(60), payload=rng.randbytes(30))
            carried = kind.startswith("carried")
            payload = write_carried(OWN, of) if carried else write_relayed(of)
            topic_id = CARRIED_TOPIC if carried else RELAYED_TOPIC
            ready = Ready(topic_id, (step, 0), payload, 0, False, False, made=step * 1e-3)
            relaying.receive(rng.choice((1, 3)), ready, step * 1e-3)
            end.handle_timeout(step * 1e-3)
            if step % 20 == 0:
                worst = max(worst, tracemalloc.get_traced_memory()[0] - before)
    finally:
        tracemalloc.stop()
    assert worst <= 2 * MOST


def test_messages_that_are_over_leave_nothing_in_topics_that_have_others() -> None:
    """What is noted of where messages began grew by topics times messages that wait in any of them."""
    of = Reassembly(10_000_000)
    for number in range(1000):
        of.add(Part(0, b"x", 0, 0, False), number, 0, repaired=False, now=0.0)
    for number in range(1000, 9000):
        for part in (Part(1 + number % 200, b"x", 0, 0, False), Part(1 + number % 200, b"x", 0, 1, True)):
            of.add(part, number, 0, repaired=False, now=0.0)
    assert sum(map(len, of._begins.values())) < 3000
