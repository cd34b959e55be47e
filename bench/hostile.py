"""What nobody sent: random, mutated and forged packets against an endpoint of version 1, which hears a real sender too.

*Damaged* ones have a trailer that does not belong to them: none may be taken. *Forged* ones have the right CRC-32,
which anybody can compute where no key is set: they may be believed, but nothing may fail, grow without bound or reserve
memory for what never came.
"""

from __future__ import annotations

import gc
import os
import random
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from bench.rows import Row
from bench.yardstick import turn_s
from fuzz.loop import inputs
from gr_ros2.core.errors import ReplayedError
from gr_ros2.link import AirPacket
from gr_ros2.link.events import Delivered, Rejected
from gr_ros2.link.v1.endpoint import EndpointV1
from gr_ros2.link.v1.endpoint_settings import Settings
from gr_ros2.link.v1.sealing import Keys
from gr_ros2.settings.config import SendOptions
from gr_ros2.settings.registry import Registry, Topic
from gr_ros2.wire import v1

Kind = Literal["damaged", "damaged, sealed", "forged"]
SHARES: dict[Kind, float] = {"damaged": 0.4, "damaged, sealed": 0.4, "forged": 0.2}
PACKETS = 10_000_000
PACKET_LEN = 64
SOURCE_BYTES, SOURCES = 1_000_000, 4
GROWTH = 20_000_000
"""Bytes by which a process may grow: ``SOURCES`` times ``SOURCE_BYTES`` and what Python needs beside it."""
_SLOT_S = 1 / 75
_BETWEEN = 50
"""Bad packets from one slot of the real link to the next."""
_LOSS = 0.2
_LOAD = 0.25
"""Messages of the real sender per slot."""
_SENDER, _RECEIVER = 1, 2
_BOOT = 1_700_000_000
_POOL = 64
_PAGE = os.sysconf("SC_PAGE_SIZE")


@dataclass
class Outcome:
    """What became of the packets.

    :param taken: bad packets that were not refused, and messages delivered that nobody sent
    :param delivered: messages of the real sender, of so many ``submitted``
    :param refused: by kind of WireError
    :param growth: bytes by which the process grew after the first tenth
    """

    fed: int = 0
    taken: int = 0
    submitted: int = 0
    delivered: int = 0
    refused: Counter[str] = field(default_factory=Counter)
    growth: int = 0
    slowest_s: float = 0.0


def attack(kind: Kind, count: int, seed: int = 1) -> Outcome:
    """Feed so many bad packets to a receiver, a real sender's packets among them."""
    rng = random.Random(seed)
    keys = Keys((bytes(range(32)),), "encrypt") if kind == "damaged, sealed" else Keys()
    topics = Registry([Topic(n, f"t{n}", "std_msgs/msg/String", SendOptions()) for n in range(3)])
    sender = EndpointV1(topics, Settings(_SENDER, PACKET_LEN, any_length=True), boot=_BOOT, keys=keys)
    settings = Settings(_RECEIVER, PACKET_LEN, max_source_bytes=SOURCE_BYTES, max_sources=SOURCES)
    receiver = EndpointV1(None, settings, boot=_BOOT, keys=keys)
    sender.pace.use_credit()
    receiver.pace.use_credit()
    outcome = Outcome()
    sent: set[bytes] = set()
    genuine: set[bytes] = set()
    pool: list[bytes] = []
    now, base = 0.0, 0

    def slot() -> None:
        """One slot of the real link."""
        if rng.random() < _LOAD:
            payload = rng.randbytes(rng.choice((5, 30, 120)))
            sent.add(payload)
            sender.messages.submit(outcome.submitted % 3, payload, now)
            outcome.submitted += 1
        for end in (sender, receiver):
            end.pace.credit()
        left = sender.next_packet(now)
        if left is not None:
            data = left.data
            genuine.add(data)
            if len(pool) < _POOL:
                pool.append(data)
            else:
                pool[rng.randrange(_POOL)] = data
            if rng.random() >= _LOSS:
                take(data, bad=False)
        answer = receiver.next_packet(now)
        if answer is not None and rng.random() >= _LOSS:
            sender.receive(AirPacket(answer.data), now)
        sender.handle_timeout(now)
        receiver.handle_timeout(now)

    def take(data: bytes, *, bad: bool) -> None:
        before = _refusals(receiver) if bad else 0
        gc.disable()  # the sets kept here would count
        begin = time.thread_time()
        events = receiver.receive(AirPacket(data), now)
        if bad and kind == "forged":
            outcome.slowest_s = max(outcome.slowest_s, time.thread_time() - begin)
        gc.enable()
        for event in events:
            if isinstance(event, Delivered):
                if event.payload in sent:
                    outcome.delivered += 1
                elif kind != "forged":
                    outcome.taken += 1
            elif isinstance(event, Rejected) and bad:
                outcome.refused[event.error.kind] += 1
        if bad and kind != "forged":
            outcome.taken += _refusals(receiver) != before + 1

    for _ in range(4 * _POOL):
        now += _SLOT_S
        slot()
    bad = _bad(pool, rng, seed)
    while outcome.fed < count:
        now += _SLOT_S
        slot()
        for _ in range(_BETWEEN):
            data = next(bad)
            if kind == "forged":
                data = _signed(data, receiver)
            if data not in genuine:
                take(data, bad=True)
                outcome.fed += 1
        if not base and outcome.fed >= count / 10:
            base = _resident()
    now += 100.0
    for event in receiver.handle_timeout(now):
        outcome.taken += isinstance(event, Delivered) and event.payload not in sent and kind != "forged"
    assert len(receiver.neighbours.all) <= SOURCES
    assert all(neighbour.inbox.held <= SOURCE_BYTES for neighbour in receiver.neighbours.all.values())
    outcome.growth = _resident() - base
    return outcome


def _bad(pool: list[bytes], rng: random.Random, seed: int) -> Iterator[bytes]:
    """Random bytes, and mutations of what is in the pool at the time."""
    for mutant in inputs(pool, seed):
        yield rng.randbytes(rng.randrange(PACKET_LEN + 2)) if rng.random() < 0.1 else mutant[:PACKET_LEN]


def _signed(data: bytes, receiver: EndpointV1) -> bytes:
    """The packet with the CRC that makes the receiver believe it."""
    neighbour, turns = receiver.neighbours.all.get(_SENDER), 0
    body = data[: -v1.CRC_LEN]
    if neighbour is not None and len(body) >= v1.HEADER_LEN:
        try:
            turns = neighbour.number(int.from_bytes(body[2:4], "big")) >> 16
        except ReplayedError:
            turns = 0
    return body + v1.crc(body, v1.session_crc(_BOOT, turns))


def _refusals(end: EndpointV1) -> int:
    return sum(end.received.rejected.values()) + sum(end.received.dropped.values())


def _resident() -> int:
    """Bytes of memory that this process has."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * _PAGE


def hostile() -> list[Row]:
    """10^7 bad packets: how many were taken, what they cost in memory and time."""
    rows: list[Row] = []
    for kind, share in SHARES.items():
        begin = time.monotonic()
        outcome = attack(kind, int(PACKETS * share))
        note = f"{outcome.fed / (time.monotonic() - begin):,.0f}/s; refused " + ", ".join(
            f"{number:,} {name}" for name, number in outcome.refused.most_common()
        )
        name = f"hostile: {outcome.fed:,} packets {kind}"
        if kind != "forged":
            rows.append(Row(f"{name}: taken", outcome.taken, "", "=", 0, note=note))
            reached = outcome.delivered / outcome.submitted
            rows.append(Row(f"{name}: PDR of the sender beside", reached, "", "≥", 0.98, "{:.4f}"))
        else:
            what = f"{name}: slowest, in thousand turns of plain Python"
            rows.append(Row(what, outcome.slowest_s / turn_s() / 1e3, "", "≤", 200, "{:.1f}", note))
        rows.append(Row(f"{name}: growth of the process", outcome.growth / 1e6, "MB", "≤", GROWTH / 1e6, "{:,.1f}"))
    return rows
