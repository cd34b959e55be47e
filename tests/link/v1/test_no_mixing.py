"""Never a message made of two, whatever is lost, doubled, late or restarted; and nothing accepted that was not sent."""

from __future__ import annotations

import random
from collections import deque

import pytest

from fuzz.loop import inputs
from gr_ros2.config import TopicOptions
from gr_ros2.link.events import Delivered
from gr_ros2.registry import Registry
from tests.link.v1.air import SLOT_S, Robot, registry

TOPICS = 3


def topics() -> Registry:
    return registry(a=TopicOptions(), b=TopicOptions(queue="latest"), c=TopicOptions(qos="bulk"))


def message(rng: random.Random, topic: int, serial: int) -> bytes:
    """One to six packets, every byte of it telling which message it belongs to."""
    head = b"%d,%d;" % (topic, serial)
    return (head * 60)[: rng.choice((20, 45, 80, 150, 280))]


@pytest.mark.parametrize("loss", [0.01, 0.05, 0.1, 0.3, 0.5])
def test_40000_messages_with_outages_restarts_reordering_and_duplicates(loss: float) -> None:
    rng = random.Random(int(loss * 1000))
    one, two = Robot(1, topics(), fixed=False), Robot(2)
    sent: list[dict[bytes, int]] = [{} for _ in range(TOPICS)]
    latest = [-1] * TOPICS
    now, serial, outage, here = 0.0, 0, 0, 0
    late: deque[bytes] = deque()

    def hear(data: bytes) -> None:
        nonlocal here
        for event in two.receive(data, now):
            if isinstance(event, Delivered):
                number = sent[event.topic_id].get(event.payload)
                assert number is not None, f"never sent: {event.payload!r}"
                assert number > latest[event.topic_id], "twice, or out of order"
                latest[event.topic_id] = number
                here += 1

    while serial < 40_000:
        now += SLOT_S
        if rng.random() < 0.4 and sum(one.end.outbox.queued().values()) < 20:
            topic = rng.randrange(TOPICS)
            payload = message(rng, topic, serial)
            sent[topic][payload] = serial
            one.end.submit(topic, payload, now)
            serial += 1
        if rng.random() < 1 / 20_000:
            one.start()
            now += rng.random()
        if rng.random() < 1 / 20_000:
            outage = rng.choice((10, 40, 200, 2000))
        outage -= outage > 0
        data = one.slot(now)
        if data is not None and not outage and rng.random() >= loss:
            if rng.random() < 0.02:
                late.append(data)
            else:
                hear(data)
                if rng.random() < 0.02:
                    hear(data)
        while late and rng.random() < 0.1:
            hear(late.popleft())
        answer = two.slot(now)
        if answer is not None and not outage and rng.random() >= loss:
            one.receive(answer, now)
        if int(now / SLOT_S) % 8 == 0:
            one.events += one.end.handle_timeout(now)
            two.events += two.end.handle_timeout(now)
    assert here > 10_000


@pytest.mark.parametrize("mode", ["none", "encrypt"])
def test_nothing_is_accepted_that_was_not_sent(mode: str) -> None:
    one, two = (Robot(n, registry(), mode=mode, fixed=False) for n in (1, 2))  # type: ignore[arg-type]
    rng = random.Random(5)
    now = 0.0
    sent = set()
    genuine: list[bytes] = []
    for number in range(40):
        payload = rng.randbytes(rng.choice((5, 30, 120)))
        sent.add(payload)
        one.end.submit(number % 3, payload, now)
        for _ in range(4):
            now += SLOT_S
            data = one.slot(now)
            if data is not None:
                genuine.append(data)
                if rng.random() < 0.8:
                    two.receive(data, now)
    for data, _ in zip(inputs(genuine, 7), range(60_000), strict=False):
        now += 0.001
        for event in two.receive(data[:64], now):
            assert not isinstance(event, Delivered) or event.payload in sent
    two.events += two.end.handle_timeout(now)
    here = two.delivered()
    assert len(here) == len(set(here))
    inbox = two.end.neighbours.get(1).inbox  # type: ignore[union-attr]
    assert inbox.held <= two.settings.max_source_bytes
    assert len(two.end.neighbours) <= two.settings.max_sources
