"""What is dropped at the source: whole messages, each under its own name."""

from __future__ import annotations

from collections import Counter
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gr_ros2.config import TopicOptions, build
from gr_ros2.errors import ConfigError
from gr_ros2.link import Sender
from gr_ros2.link.fragment import Outgoing
from gr_ros2.link.queues import TopicQueue, queue_for
from tests.link.engines import delivered, drain, read, receiver, sender


def engine(**options: Any) -> Sender:
    return sender(topics=1, packet_len=64, topic_options={"t0": TopicOptions(**options)})


def refused(engine: Sender) -> dict[str, int]:
    return {reason: count for (_, reason), count in engine.stats.refused.items()}


def test_latest_sends_the_newest_and_finishes_what_it_began() -> None:
    source = engine(queue="latest")
    source.submit(0, b"a" * 100, 0.0)
    first = source.next_packet(0.0)
    for letter in (b"b", b"c", b"d"):
        source.submit(0, letter * 20, 0.0)
    assert [read(data).entries[0].payload for data in [first or b"", *drain(source)]] == [
        b"a" * 51,
        b"a" * 49,
        b"d" * 20,
    ]
    assert refused(source) == {"superseded": 2}


def test_latest_holds_a_recording_back_while_one_waits() -> None:
    source = engine(queue="latest")
    assert source.room(0)
    source.submit(0, b"a" * 100, 0.0)
    assert not source.room(0)
    source.next_packet(0.0)
    assert source.room(0)


def test_a_queue_follows_the_depth_of_its_topic() -> None:
    assert queue_for(TopicOptions(depth=1)) == ("latest", 0.0)
    assert queue_for(TopicOptions(depth=10)) == queue_for(TopicOptions()) == ("fifo", 0.0)
    assert queue_for(TopicOptions(depth=1, queue="fifo")) == ("fifo", 0.0)


@pytest.mark.parametrize(
    ("options", "depth", "lifespan_s", "period_s", "queue"),
    [
        ({}, 1, 0.0, 0.0, ("latest", 0.0)),
        ({}, 10, 0.2, 0.0, ("deadline", 0.2)),
        ({}, 1, 0.2, 0.0, ("latest", 0.2)),
        ({}, 10, 0.0, 0.1, ("latest", 0.0)),
        ({}, 0, 0.0, 0.0, ("fifo", 0.0)),
        ({"depth": 5}, 1, 0.0, 0.1, ("fifo", 0.0)),
        ({"max_rate": 5.0}, 10, 0.0, 0.0, ("latest", 0.0)),
        ({"max_rate": 5.0, "queue": "fifo"}, 10, 0.0, 0.0, ("fifo", 0.0)),
        ({"queue": "fifo"}, 1, 0.2, 0.1, ("fifo", 0.0)),
        ({"deadline_s": 0.05}, 10, 0.2, 0.0, ("deadline", 0.05)),
        ({"queue": "latest", "deadline_s": 0.05}, 10, 0.2, 0.0, ("latest", 0.05)),
    ],
)
def test_a_queue_follows_its_publishers_where_it_is_not_configured(
    options: dict[str, Any], depth: int, lifespan_s: float, period_s: float, queue: tuple[str, float]
) -> None:
    source = engine(**options)
    before = source.queue(0)
    assert source.follow(0, depth=depth, lifespan_s=lifespan_s, period_s=period_s) == (source.queue(0) != before)
    assert source.queue(0) == queue


def test_a_lifespan_found_late_holds_for_what_waits() -> None:
    source = engine()
    source.submit(0, b"old", 0.0)
    source.follow(0, lifespan_s=0.1)
    source.submit(0, b"young", 0.09)
    assert [read(data).entries[0].payload for data in drain(source, 0.15)] == [b"young"]
    assert refused(source) == {"stale": 1}
    source.submit(0, b"for ever again", 0.2)
    source.follow(0)
    assert source.queue(0) == ("fifo", 0.0)
    assert len(drain(source, 9.0)) == 1


def test_a_deadline_queue_needs_a_deadline() -> None:
    with pytest.raises(ConfigError, match="deadline_s is missing"):
        build(TopicOptions, {"queue": "deadline"})


def test_what_has_waited_too_long_is_stale() -> None:
    source = engine(queue="deadline", deadline_s=0.1)
    source.submit(0, b"old", 0.0)
    source.submit(0, b"new", 0.06)
    assert [read(data).entries[0].payload for data in drain(source, 0.1)] == [b"new"]
    assert refused(source) == {"stale": 1}


def test_what_cannot_be_across_in_time_is_not_started() -> None:
    source = sender(
        topics=1, packet_len=64, packet_rate=10, topic_options={"t0": TopicOptions(queue="deadline", deadline_s=0.25)}
    )
    source.submit(0, bytes(3 * 51), 0.0)
    source.submit(0, bytes(2 * 51), 0.0)
    totals = []
    now = 0.0
    while (at := source.next_timeout()) is not None:
        now = max(now, at)
        totals += [read(data).entries[0].total for data in drain(source, now)]
    assert refused(source) == {"cannot_complete": 1}, "three packets at ten a second take 300 ms"
    assert totals == [2, 2]


def test_what_has_become_pointless_is_abandoned_and_the_next_arrives() -> None:
    source = engine(queue="deadline", deadline_s=0.1)
    sink = receiver(topics=1, packet_len=64)
    source.submit(0, b"a" * 100, 0.0)
    first = source.next_packet(0.0)
    assert first is not None
    sink.receive(first, 0.0)
    source.submit(0, b"b" * 30, 0.2)
    packets = drain(source, 0.2)
    assert refused(source) == {"abandoned": 1}
    assert [payload for data in packets for payload in delivered(sink.receive(data, 0.2))] == [b"b" * 30]
    assert source.stats.sent[0] == 1


def test_the_pace_of_credits_is_learnt_while_busy() -> None:
    source = sender(topics=1, packet_len=64, queue_depth=0)
    source.use_credit()
    assert source.interval == 0.0
    for number in range(20):
        source.submit(0, bytes(40), number * 0.05)
        source.submit(0, bytes(40), number * 0.05)
        source.credit()
        assert source.next_packet(number * 0.05) is not None
    assert source.interval == pytest.approx(0.05)


def test_idle_time_is_no_pace() -> None:
    source = sender(topics=1, packet_len=64)
    source.use_credit()
    for number in range(5):
        source.credit()
        source.submit(0, bytes(40), number * 1.0)
        source.next_packet(number * 1.0)
    assert source.interval == 0.0


def test_a_rate_cap_spaces_the_messages_of_a_topic() -> None:
    source = engine(queue="latest", max_rate=10.1)
    sent = []
    for millisecond in range(0, 1000, 20):
        source.submit(0, millisecond.to_bytes(2, "big"), millisecond / 1e3)
        sent += [(millisecond, data) for data in drain(source, millisecond / 1e3)]
    assert [millisecond for millisecond, _ in sent] == list(range(0, 1000, 100)), "ten a second"
    assert all(int.from_bytes(read(data).entries[0].payload, "big") == at for at, data in sent), "always the newest"


def test_a_capped_message_says_when_it_may_go() -> None:
    source = engine(queue="fifo", max_rate=10)
    source.submit(0, b"a", 0.0)
    source.submit(0, b"b", 0.0)
    assert len(drain(source, 0.0)) == 1
    assert source.next_timeout() == pytest.approx(0.1)
    assert len(drain(source, 0.1)) == 1
    assert source.next_timeout() is None


@pytest.mark.parametrize("scheduler", ["paper", "freshness"])
@given(
    steps=st.lists(st.tuples(st.integers(0, 2), st.integers(0, 300), st.floats(0, 0.05)), max_size=60),
    policy=st.sampled_from(["latest", "fifo", "deadline"]),
    max_rate=st.sampled_from([0.0, 30.0]),
)
def test_every_message_ends_once(
    scheduler: str, steps: list[tuple[int, int, float]], policy: str, max_rate: float
) -> None:
    options = build(TopicOptions, {"queue": policy, "deadline_s": 0.06, "max_rate": max_rate, "queue_depth": 3})
    source = sender(
        packet_len=64, scheduler=scheduler, packet_rate=50, topic_options={f"t{number}": options for number in range(3)}
    )
    now = 0.0
    for topic, size, pause in steps:
        source.submit(topic, bytes(size), now)
        now += pause
        drain(source, now)
    while (at := source.next_timeout()) is not None:
        now = max(now + 1e-6, at)
        drain(source, now)
    drain(source, now + 10.0)
    ended = Counter(topic for topic, _ in source.stats.refused.elements()) + source.stats.sent
    assert source.idle
    assert ended == source.stats.submitted


def test_a_message_may_be_useless_before_the_deadline_of_its_queue() -> None:
    queue = TopicQueue("deadline", 60.0)
    lifespans = (60.0, 2.0, 100.0, 5.0)
    for serial, lifespan_s in enumerate(lifespans):
        queue.admit(Outgoing(serial, 0, b"message", 0, 10.0, lifespan_s=lifespan_s), 0)
    assert [message.expires for message in queue] == [70.0, 12.0, 70.0, 15.0]
    dropped = list(queue.expire(12.5, 0.0, 0.0, 50))
    assert [(item.message.serial, item.row, item.detail) for item in dropped] == [
        (1, "stale", "it waited longer than 2000 ms")
    ]
    assert [item.message.serial for item in queue.expire(16.0, 0.0, 0.0, 50)] == [3]
    assert [message.serial for message in queue] == [0, 2]
