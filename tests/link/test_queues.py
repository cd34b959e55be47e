"""What is dropped at the source: whole messages, each under its own name."""

from __future__ import annotations

from collections import Counter
from math import inf
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gr_ros2.core.errors import ConfigError
from gr_ros2.link import SentPacket
from gr_ros2.link.queues import OVERLOAD_S, Outgoing, PublisherQos, TopicQueue, queue_for
from gr_ros2.link.v1.endpoint import EndpointV1
from gr_ros2.settings.config import SendOptions, build
from gr_ros2.settings.registry import Registry, Topic
from gr_ros2.wire.v1 import TABLE_TOPIC, Part
from tests.link.engines import sender
from tests.link.v1.air import Robot


def robot(topics: int = 1, packet_rate: float | str = "auto", **options: Any) -> Robot:
    """A robot of version 1, which has these policies, in packets of 64 B with room for 51."""
    found = [Topic(n, f"t{n}", "std_msgs/msg/String", SendOptions(**options)) for n in range(topics)]
    return Robot(1, Registry(found), hears=False, repair="off", packet_rate=packet_rate)


def leave(source: Robot, now: float, most: int = 1000) -> list[bytes]:
    """The parts of messages that leave at a time, as many as there are, or as are wanted."""
    parts: list[bytes] = []
    while len(parts) < most and source.slot(now) is not None:
        left = source.events[-1]
        assert isinstance(left, SentPacket)
        found = [part for part in left.packet.entries if isinstance(part, Part)]
        parts += [part.payload for part in found if part.topic_id != TABLE_TOPIC]
    return parts


def refused(end: EndpointV1) -> dict[str, int]:
    return {reason: count for (_, reason), count in end.sent.refused.items()}


def test_latest_sends_the_newest_and_finishes_what_it_began() -> None:
    source = robot(queue="latest")
    leave(source, 0.0)
    source.end.messages.submit(0, b"a" * 100, 0.1)
    begun = leave(source, 0.1, 1)
    for letter in (b"b", b"c", b"d"):
        source.end.messages.submit(0, letter * 20, 0.1)
    assert b"".join([*begun, *leave(source, 0.1)]) == b"a" * 100 + b"d" * 20
    assert refused(source.end) == {"superseded": 2}


def overloaded(source: Robot, airtime: float, seconds: float = 8.0) -> dict[int, list[float]]:
    """50 messages/s of each topic, and a packet of one message every 50 ms; for each topic, the ages of what leaves.

    :param airtime: s that a packet takes, at most 50 ms; the rest is spent by the computer
    """
    ages: dict[int, list[float]] = {}
    free = now = 0.0
    for tick in range(round(seconds * 100)):
        now = tick / 100
        if tick % 2 == 0:
            for topic_id in source.topics or ():
                source.end.messages.submit(topic_id.topic_id, tick.to_bytes(4, "big").ljust(45, b"."), now)
        if tick % 5 == 0:
            source.end.pace.credit(1, free)
            sent = source.end.next_packet(now)
            free = now + airtime
            for part in () if sent is None else sent.packet.entries:
                if isinstance(part, Part) and part.topic_id != TABLE_TOPIC:
                    ages.setdefault(part.topic_id, []).append(now - int.from_bytes(part.payload[:4], "big") / 100)
    return ages


def test_a_computer_that_is_too_slow_drops_the_oldest_and_starves_no_topic() -> None:
    source = robot(3)
    ages = overloaded(source, airtime=0.005)
    assert set(refused(source.end)) == {"overload"}
    for late in ages.values():
        assert max(late) < 1.5  # the queue of two topics while the third has its turn, at the beginning
        assert max(late[len(late) // 2 :]) < OVERLOAD_S + 0.05 * (3 + 1)
    counts = [len(late) for late in ages.values()]
    assert len(counts) == 3
    assert min(counts) > 0.5 * max(counts)


def test_a_topic_whose_every_message_is_wanted_loses_none_to_a_slow_computer_before_its_bound() -> None:
    source = robot(3, queue="fifo")
    overloaded(source, airtime=0.005)
    assert set(refused(source.end)) == {"queue_bound"}


def test_an_air_that_is_too_slow_drops_at_the_bound_of_the_queue() -> None:
    source = robot(3)
    ages = overloaded(source, airtime=0.05)
    assert set(refused(source.end)) == {"queue_bound"}
    assert max(max(late) for late in ages.values()) > 1.9


def test_a_burst_after_which_nothing_comes_leaves_whole_however_slow_the_computer_is() -> None:
    source = robot()
    overloaded(source, airtime=0.005, seconds=3.0)
    assert source.end._sending.behind(3.0)
    leave(source, 4.0)
    before = source.end.sent.refused.copy()
    left = 0
    for number in range(50):
        source.end.messages.submit(0, b"%d" % number, 20.0)
    for turn in range(200):
        source.end.pace.credit(1, 0.0)
        sent = source.end.next_packet(20.0 + turn / 20)
        left += 0 if sent is None else sum(isinstance(part, Part) for part in sent.packet.entries)
    assert left >= 50
    assert source.end.sent.refused == before


def test_a_sending_thread_that_does_not_run_is_a_computer_that_is_too_slow() -> None:
    source = robot()
    leave(source, 0.0)
    source.end.pace.credit(1, 0.0)
    for tick in range(200):
        source.end.messages.submit(0, bytes(45), 1.0 + tick / 50)
    assert set(refused(source.end)) == {"overload"}
    assert source.end.messages.queued() == {0: 1 + round(OVERLOAD_S * 50)}


def test_what_waited_too_long_on_the_ros_graph_of_a_slow_computer_is_dropped_before_it_is_coded() -> None:
    source = robot()
    overloaded(source, airtime=0.005, seconds=3.0)
    source.end.messages.submit(0, bytes(45), 3.0)
    before, queued = refused(source.end)["overload"], source.end.messages.queued()[0]
    for waited_s in (0.3, 0.26, 0.2, 0.0):
        source.end.messages.submit(0, bytes(45), 3.0, waited_s=waited_s)
    assert refused(source.end) == {"overload": before + 2}
    assert source.end.messages.queued()[0] == queued + 2


def test_what_waited_on_the_ros_graph_leaves_where_the_computer_keeps_up() -> None:
    source = robot()
    leave(source, 0.0)
    source.end.pace.credit(1, 0.0)
    for waited_s in (0.3, 0.2, 0.0):
        source.end.messages.submit(0, bytes(45), 5.0, waited_s=waited_s)
    assert not refused(source.end)


def test_a_robot_that_nobody_hears_is_not_too_slow() -> None:
    found = [Topic(0, "t", "std_msgs/msg/String", SendOptions(queue="fifo"))]
    source = Robot(1, Registry(found), hears=True, beacon_s=1.0)
    leave(source, 0.0)
    source.end.pace.credit(1, 0.0)
    for tick in range(200):
        source.end.messages.submit(0, bytes(45), 5.0 + tick / 50)
    assert set(refused(source.end)) == {"queue_bound"}


def test_messages_that_max_rate_holds_back_do_not_wait_for_the_computer() -> None:
    source = robot(queue="fifo", max_rate=5.0)
    overloaded(source, airtime=0.005)
    assert set(refused(source.end)) == {"queue_bound"}


def test_latest_holds_a_recording_back_while_one_waits() -> None:
    source = robot(queue="latest")
    leave(source, 0.0)
    assert source.end.messages.has_space(0)
    source.end.messages.submit(0, b"a" * 100, 0.1)
    assert not source.end.messages.has_space(0)
    leave(source, 0.1, 1)
    assert source.end.messages.has_space(0)


def test_a_queue_follows_the_depth_of_its_topic() -> None:
    assert queue_for(SendOptions(depth=1)) == ("latest", 0.0)
    assert queue_for(SendOptions(depth=10)) == queue_for(SendOptions()) == ("fifo", 0.0)
    assert queue_for(SendOptions(depth=1, queue="fifo")) == ("fifo", 0.0)


@pytest.mark.parametrize(
    ("options", "depth", "lifespan_s", "period_s", "queue"),
    [
        ({}, 1, 0.0, 0.0, ("latest", 0.0)),
        ({}, 10, 0.2, 0.0, ("deadline", 0.2)),
        ({}, 1, 0.2, 0.0, ("latest", 0.2)),
        ({}, 10, 0.0, 0.1, ("latest", 0.0)),
        ({}, 0, 0.0, 0.0, ("fifo", 0.0)),
        ({"depth": 5}, 1, 0.0, 0.1, ("fifo", 0.0)),
        ({"queue": "fifo"}, 1, 0.2, 0.1, ("fifo", 0.0)),
        ({"deadline_s": 0.05}, 10, 0.2, 0.0, ("deadline", 0.05)),
        ({"queue": "latest", "deadline_s": 0.05}, 10, 0.2, 0.0, ("latest", 0.05)),
    ],
)
def test_a_queue_follows_its_publishers_where_it_is_not_configured(
    options: dict[str, Any], depth: int, lifespan_s: float, period_s: float, queue: tuple[str, float]
) -> None:
    source = robot(**options).end
    before = source.messages.queue(0)
    assert source.messages.follow(0, PublisherQos(depth=depth, lifespan_s=lifespan_s, period_s=period_s)) == (
        source.messages.queue(0) != before
    )
    assert source.messages.queue(0) == queue


def test_a_lifespan_found_late_holds_for_what_waits() -> None:
    source = robot()
    source.end.messages.submit(0, b"old", 0.0)
    source.end.messages.follow(0, PublisherQos(lifespan_s=0.1))
    source.end.messages.submit(0, b"young", 0.09)
    assert leave(source, 0.15) == [b"young"]
    assert refused(source.end) == {"stale": 1}
    source.end.messages.submit(0, b"for ever again", 0.2)
    source.end.messages.follow(0, PublisherQos())
    assert source.end.messages.queue(0) == ("fifo", 0.0)
    assert leave(source, 9.0) == [b"for ever again"]


def test_a_deadline_queue_needs_a_deadline() -> None:
    with pytest.raises(ConfigError, match="deadline_s is missing"):
        build(SendOptions, {"queue": "deadline"})


def test_what_has_waited_too_long_is_stale() -> None:
    source = robot(queue="deadline", deadline_s=0.1)
    source.end.messages.submit(0, b"old", 0.0)
    source.end.messages.submit(0, b"new", 0.06)
    assert leave(source, 0.1) == [b"new"]
    assert refused(source.end) == {"stale": 1}


def test_what_cannot_be_across_in_time_is_not_started() -> None:
    source = robot(packet_rate=10.0, queue="deadline", deadline_s=0.25)
    for step in range(10):  # hello and table
        source.slot(0.1 * step)
    source.end.messages.submit(0, bytes(150), 1.0)
    source.end.messages.submit(0, bytes(70), 1.0)
    left = [part for step in range(10) for part in leave(source, 1.0 + 0.1 * step)]
    assert refused(source.end) == {"cannot_complete": 1}, "more than two packets at ten a second take 300 ms"
    assert sum(map(len, left)) == 70


def test_what_has_become_pointless_is_abandoned_and_the_next_leaves() -> None:
    source = robot(queue="deadline", deadline_s=0.1)
    leave(source, 0.0)
    source.end.messages.submit(0, b"a" * 100, 0.1)
    leave(source, 0.1, 1)
    source.end.messages.submit(0, b"b" * 30, 0.3)
    assert leave(source, 0.3) == [b"b" * 30]
    assert refused(source.end) == {"abandoned": 1}


def test_the_pace_of_credits_is_learnt_while_busy() -> None:
    source = sender(rows=1, packet_len=64, queue_depth=0)
    source.pace.use_credit()
    assert source.pace.interval == 0.0
    for number in range(20):
        source.submit(0, bytes(40), number * 0.05)
        source.submit(0, bytes(40), number * 0.05)
        source.pace.credit()
        assert source.next_packet(number * 0.05) is not None
    assert source.pace.interval == pytest.approx(0.05)


def test_idle_time_is_no_pace() -> None:
    source = sender(rows=1, packet_len=64)
    source.pace.use_credit()
    for number in range(5):
        source.pace.credit()
        source.submit(0, bytes(40), number * 1.0)
        source.next_packet(number * 1.0)
    assert source.pace.interval == 0.0


def test_a_rate_cap_spaces_the_messages_of_a_topic() -> None:
    source = robot(queue="latest", max_rate=10.1)
    sent = []
    for millisecond in range(0, 1000, 20):
        source.end.messages.submit(0, millisecond.to_bytes(2, "big"), millisecond / 1e3)
        sent += [(millisecond, int.from_bytes(part, "big")) for part in leave(source, millisecond / 1e3)]
    assert sent == [(at, at) for at in range(0, 1000, 100)], "ten a second, always the newest"


def test_a_capped_message_says_when_it_may_go() -> None:
    source = robot(queue="fifo", max_rate=10)
    source.end.messages.submit(0, b"a", 0.0)
    source.end.messages.submit(0, b"b", 0.0)
    assert leave(source, 0.0) == [b"a"]
    assert source.end.messages.packing.next_timeout(0.0) == pytest.approx(0.1)
    assert leave(source, 0.1) == [b"b"]
    assert source.end.messages.packing.next_timeout(0.1) == inf


@given(
    steps=st.lists(st.tuples(st.integers(0, 2), st.integers(0, 300), st.floats(0, 0.05)), max_size=60),
    policy=st.sampled_from(["latest", "fifo", "deadline"]),
    max_rate=st.sampled_from([0.0, 30.0]),
)
def test_every_message_ends_once(steps: list[tuple[int, int, float]], policy: str, max_rate: float) -> None:
    depth = {} if policy == "latest" else {"queue_depth": 3}
    source = robot(3, queue=policy, deadline_s=0.06, max_rate=max_rate, **depth)
    now = 0.0
    for topic, size, pause in steps:
        source.end.messages.submit(topic, bytes(size), now)
        now += pause
        source.slot(now)
    for step in range(300):
        leave(source, now + 0.02 * step)
    ended = Counter(topic for topic, _ in source.end.sent.refused.elements()) + source.end.sent.sent
    assert source.end.messages.idle
    assert ended == source.end.sent.submitted


def test_a_message_may_be_useless_before_the_deadline_of_its_queue() -> None:
    queue: TopicQueue[Outgoing] = TopicQueue("deadline", 60.0)
    lifespans = (60.0, 2.0, 100.0, 5.0)
    for serial, lifespan_s in enumerate(lifespans):
        queue.admit(Outgoing(serial, 0, b"message", 0, 10.0, lifespan_s=lifespan_s), 0)
    assert [message.expires for message in queue] == [70.0, 12.0, 70.0, 15.0]
    dropped = list(queue.expire(12.5, 0.0, 0.0, 50))
    assert [(item.message.serial, item.fate, item.detail) for item in dropped] == [
        (1, "stale", "it waited longer than 2000 ms")
    ]
    assert [item.message.serial for item in queue.expire(16.0, 0.0, 0.0, 50)] == [3]
    assert [message.serial for message in queue] == [0, 2]
