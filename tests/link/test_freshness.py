"""Freshness: the young before the old, latency before the rest, full packets, and nobody starves."""

from __future__ import annotations

import random
from collections import Counter
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gr_ros2.config import TopicOptions, build
from gr_ros2.link import Delivered, Sender
from gr_ros2.link.freshness import TURN, Turns
from gr_ros2.wire.v0 import V0
from tests.link.engines import delivered, drain, read, receiver, sender, take, trace


def engine(topics: int = 3, packet_len: int = 220, **options: Any) -> Sender:
    return sender(
        topics,
        packet_len=packet_len,
        scheduler="freshness",
        queue_depth=0,
        topic_options={name: build(TopicOptions, values) for name, values in options.items()},
    )


def test_one_topic_alone_is_cut_as_the_paper_cuts_it() -> None:
    source = engine(topics=1, packet_len=64)
    source.submit(0, bytes(724), 0.0)
    assert trace(drain(source)) == [[(0, index, 15)] for index in range(15)]


def test_the_topic_that_grows_youngest_per_byte_goes_first() -> None:
    source = engine(packet_len=64)
    for topic in range(3):
        source.submit(topic, bytes(51), 0.0)
    assert len(drain(source)) == TURN - 1
    source.submit(0, bytes(51), 0.0)  # whatever comes fourth has its turn
    drain(source)
    source.submit(0, bytes(51), 0.1)
    source.submit(1, bytes(51), 0.3)
    source.submit(2, bytes(30), 0.2)
    assert [entries[0][0] for entries in trace(drain(source))] == [1, 2, 0]


def test_weight_counts() -> None:
    source = engine(topics=2, packet_len=64, t1={"weight": 10})
    for now in (0.0, 1.0):
        source.submit(0, bytes(51), now)
        source.submit(1, bytes(51), now)
        assert [entries[0][0] for entries in trace(drain(source, now))] == [1, 0]


def test_bulk_fills_what_is_left() -> None:
    source = engine(topics=2, packet_len=220, t1={"qos": "bulk"})
    source.submit(1, bytes(3000), 0.0)
    source.submit(0, bytes(80), 0.0)
    first = read(drain(source)[0])
    assert [entry.topic_id for entry in first.entries] == [0, 1]
    assert 220 - V0.packed_len([len(entry.payload) for entry in first.entries]) <= 1


def test_a_message_of_two_packets_does_not_start_in_the_rest_of_another() -> None:
    source = engine(topics=1, packet_len=64)
    source.submit(0, bytes(85), 0.0)
    source.submit(0, bytes(85), 0.0)
    assert trace(drain(source)) == [[(0, 0, 2)], [(0, 1, 2)], [(0, 0, 2)], [(0, 1, 2)]]


def test_unless_that_saves_a_packet() -> None:
    source = engine(topics=1, packet_len=64)
    source.submit(0, bytes(60), 0.0)
    source.submit(0, bytes(60), 0.0)
    assert trace(drain(source)) == [[(0, 0, 2)], [(0, 1, 2), (0, 0, 2)], [(0, 1, 2)]]


@settings(max_examples=150, deadline=None)
@given(
    messages=st.lists(
        st.tuples(st.integers(0, 3), st.integers(0, 3000), st.integers(0, 3), st.floats(0, 0.1)), max_size=25
    ),
    packet_len=st.sampled_from([40, 50, 64, 115, 220, 500]),
    classes=st.lists(st.sampled_from(["default", "latency", "bulk"]), min_size=4, max_size=4),
    min_fragment=st.sampled_from([1, 16, 27]),
)
def test_every_message_arrives_whole_and_in_order_however_it_is_cut(
    messages: list[tuple[int, int, int, float]], packet_len: int, classes: list[str], min_fragment: int
) -> None:
    """Packets go in between the submissions, so that messages of all classes meet others half sent."""
    options = {f"t{number}": build(TopicOptions, {"qos": qos}) for number, qos in enumerate(classes)}
    source = sender(
        4,
        packet_len=packet_len,
        min_fragment=min_fragment,
        scheduler="freshness",
        queue_depth=0,
        topic_options=options,
    )
    sink = receiver(4, packet_len=packet_len)
    noise = random.Random(len(messages))
    sent: dict[int, list[bytes]] = {topic: [] for topic in range(4)}
    got: dict[int, list[bytes]] = {topic: [] for topic in range(4)}

    def arrive(data: bytes | None) -> None:
        if data is not None:
            for event in take(sink, data, now):
                assert isinstance(event, Delivered)
                got[event.topic_id].append(event.payload)

    now = 0.0
    for topic, size, packets, pause in messages:
        now += pause
        payload = noise.randbytes(size)
        sent[topic].append(payload)
        source.submit(topic, payload, now)
        for _ in range(packets):
            arrive(source.next_packet(now))
    for data in drain(source, now):
        arrive(data)
    too_large = {topic for topic, reason in source.stats.refused if reason == "too_large"}
    assert source.idle
    assert all(got[topic] == sent[topic] for topic in range(4) if topic not in too_large)


@settings(max_examples=40, deadline=None)
@given(
    sizes=st.lists(st.integers(1, 2500), min_size=2, max_size=6),
    classes=st.lists(st.sampled_from(["default", "default", "latency", "bulk"]), min_size=6, max_size=6),
    weights=st.lists(st.sampled_from([0.001, 1.0, 1000.0]), min_size=6, max_size=6),
    packet_len=st.sampled_from([64, 115, 220]),
)
def test_nothing_starves(sizes: list[int], classes: list[str], weights: list[float], packet_len: int) -> None:
    """A topic that keeps publishing is delivered at least once in so many packets, whatever the others offer.

    The bound: a turn comes within TURN packets per topic, and a message needs no more of them than it has fragments.
    """
    topics = len(sizes)
    options: dict[str, Any] = {
        f"t{n}": {"qos": classes[n], "weight": weights[n], "queue": "latest"} for n in range(topics)
    }
    source = engine(topics, packet_len, **options)
    single, half = V0.single_entry_payload(packet_len), V0.equal_entry_payload(packet_len, 2)
    cut = min(single - half - 6, 3 * single // 4)
    bounds = [TURN * topics * (1 + -(-size // cut)) for size in sizes]
    last = [0] * topics
    sink = receiver(topics, packet_len=packet_len, reassembly_timeout_s=1e6)
    for packet in range(min(2 * max(bounds), 1500)):
        now = packet * 0.01
        for topic, size in enumerate(sizes):
            source.submit(topic, bytes([topic]) * size, now)
        data = source.next_packet(now)
        assert data is not None
        for payload in delivered(sink.receive(data, now)):
            last[payload[0]] = packet
        for topic in range(topics):
            assert packet - last[topic] <= bounds[topic], f"topic {topic} of {classes}, {sizes}"


@settings(max_examples=100, deadline=None)
@given(
    others=st.lists(st.tuples(st.integers(1, 2), st.integers(0, 3000), st.integers(0, 4)), min_size=1, max_size=20),
    size=st.integers(1, 400),
    packet_len=st.sampled_from([64, 115, 220]),
    bulk=st.booleans(),
)
def test_a_latency_message_is_in_the_next_packet(
    others: list[tuple[int, int, int]], size: int, packet_len: int, bulk: bool
) -> None:
    source = engine(3, packet_len, t0={"qos": "latency"}, t2={"qos": "bulk" if bulk else "default"})
    now = 0.0
    for topic, other, packets in others:
        source.submit(topic, bytes(other), now)
        for _ in range(packets):
            source.next_packet(now)
        now += 0.01
        if source.queued()[0] == 0:
            source.submit(0, bytes(size), now)
            data = source.next_packet(now)
            assert data is not None
            assert 0 in [entry.topic_id for entry in read(data).entries if entry.index == 0]


SIZES = {"scan": 980, "odom": 85, "imu": 110, "cmd_vel": 17, "map": 1500, "clock": 10}
RATES = {"scan": 10, "odom": 35, "imu": 50, "cmd_vel": 10, "clock": 10}


@pytest.mark.parametrize("sizes", [SIZES, {**SIZES, "scan": 5828, "odom": 724, "imu": 324}], ids=["coded", "plain"])
def test_packets_are_filled(sizes: dict[str, int]) -> None:
    """The six topics of the paper's table 4 at 220 B, 29 packets a second, which is less than they want."""
    classes = {"cmd_vel": "latency", "map": "bulk"}
    names = list(sizes)
    options: dict[str, Any] = {
        f"t{n}": {"qos": classes.get(name, "default"), "queue": "latest"} for n, name in enumerate(names)
    }
    source = engine(len(names), 220, **options)
    due = dict.fromkeys(RATES, 0.0)
    source.submit(names.index("map"), bytes(sizes["map"]), 0.0)
    pad, packets = 0, 0
    for packet in range(29 * 20):
        now = packet / 29
        for name, rate in RATES.items():
            while due[name] <= now:
                source.submit(names.index(name), bytes(sizes[name]), due[name])
                due[name] += 1 / rate
        data = source.next_packet(now)
        assert data is not None
        pad += 220 - V0.packed_len([len(entry.payload) for entry in read(data).entries])
        packets += 1
    assert pad / (packets * 220) < 0.10
    assert all(source.stats.sent[topic] for topic in range(len(names)))
    assert Counter(reason for _, reason in source.stats.refused).keys() == {"superseded"}


def test_turns_go_round_and_the_first_ones_in_the_order_of_the_first_messages() -> None:
    turns = Turns()
    for topic_id in (4, 0, 1, 4):
        turns.join(topic_id)
    had = []
    for _ in range(5 * TURN):
        holder = turns.holder({0, 1, 4, 240})
        turns.sent(holder)
        had.append(holder)
    assert had[TURN - 1 :: TURN] == [4, 0, 1, 4, 0]
    assert set(had) == {-1, 0, 1, 4}, "240 has not joined: it has no turn"
    for _ in range(TURN):
        assert turns.holder({240}) == -1
        turns.sent(-1)
