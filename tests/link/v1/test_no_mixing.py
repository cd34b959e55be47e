"""Never a message made of two, whatever is lost, doubled, late or restarted; and nothing accepted that was not sent."""

from __future__ import annotations

import random
import tracemalloc
from collections import Counter, deque
from itertools import cycle

import pytest

from bench.hostile import GROWTH, Kind, attack
from gr_ros2.link import AirPacket
from gr_ros2.link.events import Delivered
from gr_ros2.link.v1.sealing import SealMode
from gr_ros2.settings.config import SendOptions
from gr_ros2.settings.registry import Registry
from gr_ros2.wire.v1 import MAX_MESSAGE, Part, body_room, write_body
from tests.link.v1.air import SLOT_S, Robot, registry
from tests.link.v1.invariants import PacketsEnd

TOPICS = 3
MESSAGES = 3_500
SHORT, BEFORE, AFTER = 1_500, 2_000, 1_000
HALF, ROUND = 1 << 15, 1 << 16
"""Packets of a sender's lives: some are SHORT at most, so that the two lives before and after such a one fit into all
messages whatever is drawn; others begin BEFORE half of the numbers, or all, and end AFTER."""


def topics() -> Registry:
    return registry(a=SendOptions(), b=SendOptions(queue="latest"), c=SendOptions(qos="bulk"))


def message(rng: random.Random, topic: int, serial: int) -> bytes:
    """One to six packets, every byte of it telling which message it belongs to."""
    head = b"%d,%d;" % (topic, serial)
    return (head * 60)[: rng.choice((20, 45, 80, 150, 280))]


class Weather:
    """What the air does to packets: loss, outages, and half a window lost, in one piece or every second packet."""

    def __init__(self, rng: random.Random, loss: float) -> None:
        self.happened: Counter[str] = Counter()
        self._rng, self._loss = rng, loss
        self._troubles = cycle((("outage", 10), ("half", 32), ("outage", 200), ("outage", 2000)))
        self._outage = self._thinned = 0

    def lost(self) -> bool:
        """Whether the packet of this slot is lost."""
        rng = self._rng
        if rng.random() < 1 / 2_000:
            kind, length = next(self._troubles)
            self.happened[kind] += 1
            self._outage = length
        if rng.random() < 1 / 2_500:
            self.happened["thinned"] += 1
            self._thinned = 64
        self._outage -= self._outage > 0
        self._thinned -= self._thinned > 0
        return bool(self._outage or self._thinned % 2 or rng.random() < self._loss)


def grow_old(robot: Robot, numbers: int) -> None:
    """As if it had sent nearly so many packets in this life."""
    robot.end.window.packets.newest = robot.end.window.packets.oldest = numbers - BEFORE


@pytest.mark.slow
@pytest.mark.parametrize(
    ("relaying", "loss", "mode"),
    [(False, 0.01, "encrypt"), (True, 0.1, "encrypt"), (False, 0.5, "none"), (True, 0.1, "none")],
    indirect=["relaying"],
)
@pytest.mark.usefixtures("relaying")
def test_messages_with_outages_restarts_reordering_and_duplicates(loss: float, mode: SealMode) -> None:
    """In each run both ends have several lives, in which packet numbers pass their half and come round."""
    rng = random.Random(int(loss * 1000))
    starts = random.Random(int(loss * 1000))  # of the receiver, whatever else is drawn
    one, two = Robot(1, topics(), any_length=True, mode=mode), Robot(2, mode=mode)
    invariant = PacketsEnd((one, two))
    sent: list[dict[bytes, int]] = [{} for _ in range(TOPICS)]
    latest = [-1] * TOPICS
    now, serial = 0.0, 0
    weather = Weather(rng, loss)
    happened = weather.happened
    late: deque[bytes] = deque()

    grow_old(one, ROUND)
    lives = cycle((HALF, ROUND))

    def hear(data: bytes) -> None:
        for event in two.receive(data, now):
            if isinstance(event, Delivered):
                number = sent[event.topic_id].get(event.payload)
                assert number is not None, f"never sent: {event.payload!r}"
                assert number > latest[event.topic_id], "twice, or out of order"
                latest[event.topic_id] = number
                happened["here"] += 1

    while serial < MESSAGES:
        now += SLOT_S
        if rng.random() < 0.4 and sum(one.end.messages.queued().values()) < 20:
            topic = rng.randrange(TOPICS)
            payload = message(rng, topic, serial)
            sent[topic][payload] = serial
            one.end.messages.submit(topic, payload, now)
            serial += 1
        newest = one.end.window.packets.newest
        half, came_round = HALF + AFTER < newest < ROUND - BEFORE, newest > ROUND + AFTER
        short = newest < HALF - BEFORE
        if half or came_round or (short and (newest > SHORT or rng.random() < 2 / SHORT)):
            happened["sender restarted"] += 1
            happened["half of the numbers"] += half
            happened["came round"] += came_round
            one.start()
            now += rng.random()
            if short:
                grow_old(one, next(lives))
        if starts.random() < 1 / 2_500:
            happened["receiver restarted"] += 1
            late.clear()  # the new start would take a hello from before for the point from which on it lacks everything
            two.start()
        data = one.slot(now)
        if data is not None and not weather.lost():
            if rng.random() < 0.02:
                happened["late"] += 1
                late.append(data)
            else:
                hear(data)
                if rng.random() < 0.02:
                    happened["twice"] += 1
                    hear(data)
        while late and rng.random() < 0.1:
            hear(late.popleft())
        answer = two.slot(now)
        if answer is not None and not weather.lost():
            one.receive(answer, now)
        if int(now / SLOT_S) % 8 == 0:
            one.end.handle_timeout(now)
            two.end.handle_timeout(now)
        invariant.step()
    assert happened["here"] > MESSAGES / 8
    for kind in (
        *("outage", "half", "thinned", "late", "twice"),
        *("sender restarted", "receiver restarted", "half of the numbers", "came round"),
    ):
        assert happened[kind], kind


@pytest.mark.parametrize("kind", ["damaged", "damaged, sealed", "forged"])
def test_nothing_is_accepted_that_was_not_sent_and_memory_is_bounded(kind: Kind) -> None:
    """``python -m bench hostile`` does the same with 10^7 packets."""
    outcome = attack(kind, 20_000, seed=5)
    assert outcome.taken == 0
    assert outcome.growth <= GROWTH
    assert kind == "forged" or outcome.delivered >= 0.95 * outcome.submitted


@pytest.mark.usefixtures("relaying")
@pytest.mark.parametrize("per_topic", [1, 20])
def test_nothing_is_reserved_for_a_message_that_is_announced(per_topic: int) -> None:
    """The last fragments of messages of 16 MB, and of none of them anything else."""
    one, two = Robot(1, registry()), Robot(2, max_source_bytes=200_000)
    for n in range(5):
        two.end.receive(AirPacket(one.slot(n * SLOT_S) or b""), n * SLOT_S)
    inbox = two.end.neighbours.all.get(1).inbox  # type: ignore[union-attr]
    body_len, number = 30, inbox.newest
    tracemalloc.start()
    try:
        for begin in range(per_topic):
            for topic in range(240):
                number += 1
                part = Part(topic, bytes(body_len), 200 + begin, MAX_MESSAGE - body_len, True)
                inbox.source(number, write_body([part], body_room(64)), [part], 0, 1.0)
        held, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert 0 < inbox.held <= 200_000
    assert peak < 5_000_000
    assert held < 5_000_000
