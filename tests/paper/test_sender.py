"""The paper's packing policy on traces of packets, and every way a message does not leave."""

from __future__ import annotations

import random
from collections import Counter
from itertools import pairwise
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gr_ros2.core.errors import ConfigError
from gr_ros2.link import Accepted, AirPacket, Missed, Refused, SenderEvent, SentPacket
from gr_ros2.paper.receiver import Receiver
from gr_ros2.paper.schedule import PaperScheduler
from gr_ros2.paper.sender import Sender
from gr_ros2.paper.settings import paper_from
from gr_ros2.settings.config import SendOptions
from gr_ros2.settings.registry import Registry
from tests.link.engines import delivered, drain, read, registry, sender, trace
from tests.packets import data_of


def test_one_topic_fills_packets_alone() -> None:
    engine = sender(packet_len=64)
    engine.submit(0, bytes(724), 0.0)
    packets = drain(engine)
    assert trace(packets) == [[(0, index, 15)] for index in range(15)]
    assert [len(read(data).entries[0].payload) for data in packets] == [51] * 14 + [10]


def test_two_topics_share_packets_at_e_2() -> None:
    engine = sender(packet_len=220)
    engine.submit(0, bytes(303), 0.0)
    engine.submit(1, bytes(303), 0.0)
    packets = drain(engine)
    assert trace(packets) == [[(0, 0, 3), (1, 0, 3)], [(0, 1, 3), (1, 1, 3)], [(0, 2, 3), (1, 2, 3)]]
    assert all(len(entry.payload) == 101 for data in packets for entry in read(data).entries)


def test_the_cut_of_a_message_stays_as_its_first_entry_had_it() -> None:
    engine = sender(packet_len=220)
    engine.submit(0, bytes(1000), 0.0)
    first = data_of(engine.next_packet(0.0))
    engine.submit(1, bytes(400), 0.0)
    packets = [first, *drain(engine)] if first else []
    lengths = [(e.topic_id, len(e.payload)) for data in packets for e in read(data).entries]
    assert [length for topic, length in lengths if topic == 0] == [207] * 4 + [172]
    assert {length for topic, length in lengths if topic == 1} == {101, 97}


def test_three_topics_take_turns() -> None:
    engine = sender(packet_len=220)
    for topic in range(3):
        engine.submit(topic, bytes(404), 0.0)
    order = [topic for entries in trace(drain(engine)) for topic, _, _ in entries]
    assert order[:12] == [0, 1, 2, 0, 1, 2, 0, 1, 2, 0, 1, 2]


def test_small_messages_share_one_packet_up_to_fifteen_entries() -> None:
    engine = sender(rows=16, packet_len=220)
    for topic in range(16):
        engine.submit(topic, b"tiny", 0.0)
    assert [len(entries) for entries in trace(drain(engine))] == [15, 1]


def test_a_topic_that_did_not_fit_comes_first_next_time() -> None:
    engine = sender(packet_len=220)
    engine.submit(0, bytes(101), 0.0)
    engine.submit(1, bytes(101), 0.0)
    engine.submit(2, bytes(101), 0.0)
    engine.submit(0, bytes(50), 0.0)
    assert [[topic for topic, _, _ in entries] for entries in trace(drain(engine))] == [[0, 1], [2, 0]]


def test_greedy_packs_one_topic_back_to_back() -> None:
    fair, greedy = sender(packet_len=220), sender(packet_len=220, greedy=True)
    for engine in (fair, greedy):
        for _ in range(4):
            engine.submit(0, bytes(40), 0.0)
    assert trace(drain(fair)) == [[(0, 0, 1)]] * 4
    assert trace(drain(greedy)) == [[(0, 0, 1)] * 4]


def test_min_fragment_above_k_2_gives_single_entry_packets() -> None:
    engine = sender(packet_len=64, min_fragment=30)
    engine.submit(0, bytes(60), 0.0)
    engine.submit(1, bytes(60), 0.0)
    assert trace(drain(engine)) == [[(0, 0, 2)], [(1, 0, 2)], [(0, 1, 2)], [(1, 1, 2)]]


def test_min_fragment_that_cannot_fit_is_refused() -> None:
    with pytest.raises(ConfigError, match="min_fragment = 52 does not fit packet_len = 64; at most 51"):
        paper_from(robot=1, packet_len=64, min_fragment=52)


def test_a_message_over_255_shared_entries_is_cut_at_the_full_packet() -> None:
    engine = sender(packet_len=64, queue_depth=0)
    engine.submit(0, bytes(255 * 51), 0.0)
    engine.submit(1, bytes(23), 0.0)
    entries = [entry for entries in trace(drain(engine)) for entry in entries]
    assert (0, 254, 255) in entries


def test_a_message_over_255_entries_is_refused_with_the_remedy() -> None:
    events: list[SenderEvent] = []
    engine = Sender(
        Registry.from_rows({"map": "nav_msgs/OccupancyGrid"}),
        *paper_from(robot=1, packet_len=64),
        rng=random.Random(0),
        observer=events.append,
    )
    engine.submit(0, bytes(255 * 51 + 1), 0.0)
    assert drain(engine) == []
    refused = events[-1]
    assert isinstance(refused, Refused)
    assert refused.reason == "too_large"
    assert "packet_len 65 would carry it" in refused.detail
    assert engine.stats.refused == Counter({(0, "too_large"): 1})


def test_a_full_queue_drops_the_oldest_that_has_not_started_and_counts_it() -> None:
    engine = sender(packet_len=64, queue_depth=2)
    engine.submit(0, b"a" * 100, 0.0)
    first = data_of(engine.next_packet(0.0))
    for letter in (b"b", b"c", b"d"):
        engine.submit(0, letter * 20, 0.0)
    payloads = [read(data).entries[0].payload for data in [first or b"", *drain(engine)]]
    assert payloads == [b"a" * 51, b"a" * 49, b"d" * 20]
    assert engine.stats.refused == Counter({(0, "queue_bound"): 2})


def test_flush_timeout_waits_for_company_but_not_longer() -> None:
    engine = sender(packet_len=220, flush_timeout_s=0.1)
    engine.submit(0, bytes(101), 1.0)
    assert engine.next_packet(1.0) is None
    assert engine.next_timeout() == pytest.approx(1.1)
    engine.submit(1, bytes(150), 1.05)
    assert trace(drain(engine, 1.05)) == [[(0, 0, 1), (1, 0, 2)]]
    assert trace(drain(engine, 1.2)) == [[(1, 1, 2)]]
    engine.submit(0, bytes(20), 2.0)
    assert len(drain(engine, 2.1)) == 1


def test_a_topic_faster_than_the_wait_for_company_still_leaves() -> None:
    engine = sender(packet_len=220, flush_timeout_s=1.0, queue_depth=10)
    left = []
    for step in range(1000):
        now = step * 0.01
        engine.submit(0, b"%4d" % step, now)
        left += [now] * len(drain(engine, now))
    assert left
    assert left[0] == pytest.approx(1.0, abs=0.011)
    assert len(left) >= 9


def test_a_full_packet_does_not_wait() -> None:
    engine = sender(packet_len=220, flush_timeout_s=10.0)
    engine.submit(0, bytes(207), 0.0)
    assert len(drain(engine)) == 1


def test_packet_rate_spaces_packets_and_makes_up_for_late_wake_ups() -> None:
    engine = sender(packet_len=64, packet_rate=10)
    engine.submit(0, bytes(51 * 40), 0.0)
    times = []
    now = 0.0
    while (due := engine.next_timeout()) is not None:
        now = max(due, now) + 0.03
        assert engine.next_packet(now) is not None
        times.append(now)
    assert len(times) == 40
    assert times[-1] - times[0] == pytest.approx(3.9, abs=0.2)


def test_credit_lets_exactly_so_many_packets_go() -> None:
    engine = sender(packet_len=64)
    engine.pace.use_credit()
    engine.submit(0, bytes(51 * 5), 0.0)
    assert drain(engine) == []
    assert engine.next_timeout() is None
    engine.pace.credit(2)
    assert len(drain(engine)) == 2
    engine.pace.credit()
    assert len(drain(engine)) == 1


def test_qos_of_a_packet_is_latency_if_any_bulk_only_if_all() -> None:
    options = {"t0": SendOptions(qos="latency"), "t2": SendOptions(qos="bulk")}
    for topics, expected in (((0, 1), 1), ((1,), 0), ((2,), 2), ((1, 2), 0), ((0, 2), 1)):
        engine = sender(packet_len=220, topics=options)
        for topic in topics:
            engine.submit(topic, b"x", 0.0)
        assert [read(data).qos for data in drain(engine)] == [expected]


def test_ids_count_up_per_topic_from_a_seeded_start() -> None:
    engine = sender(packet_len=64, queue_depth=0, seed=7)
    for _ in range(300):
        engine.submit(0, b"x", 0.0)
    packets = [read(data) for data in drain(engine)]
    ids = [packet.entries[0].entry_id for packet in packets]
    assert all((later - earlier) % 256 == 1 for earlier, later in pairwise(ids))
    seqs = [packet.seq for packet in packets]
    assert all((later - earlier) % 256 == 1 for earlier, later in pairwise(seqs))
    other = sender(packet_len=64, seed=8)
    other.submit(0, b"x", 0.0)
    assert read(drain(other)[0]).seq != seqs[0]


def test_transient_local_topics_are_repeated_as_bulk_with_a_fresh_id() -> None:
    engine = sender(packet_len=64, repeat_s=10, topics={"t1": SendOptions(durability="transient_local")})
    engine.submit(1, b"latched", 0.0)
    first = read(drain(engine, 0.0)[0])
    assert engine.next_timeout() == pytest.approx(10.0)
    assert drain(engine, 9.9) == []
    again = read(drain(engine, 10.0)[0])
    assert again.entries[0].payload == b"latched"
    assert again.qos == 2
    assert (again.entries[0].entry_id - first.entries[0].entry_id) % 256 == 1
    assert engine.stats.submitted[1] == 1
    assert engine.stats.sent[1] == 1
    assert engine.stats.repeats == 1


def test_a_repeat_says_which_message_it_repeats() -> None:
    events: list[SenderEvent] = []
    options = {"t1": SendOptions(durability="transient_local")}
    config = paper_from(robot=1, packet_len=64, repeat_s=10, topics=options)
    engine = Sender(registry(), *config, observer=events.append)
    for number in range(3):
        engine.submit(number % 2, b"message %d" % number, 0.0)
    drain(engine, 0.0)
    drain(engine, 10.0)
    (repeat,) = events[-1].entries if isinstance(events[-1], SentPacket) else ()
    assert (repeat.serial, repeat.topic_id, repeat.repeat) == (1, 1, True)


def test_live_settings_change() -> None:
    engine = sender(packet_len=64)
    engine.reconfigure(dst_id=7)
    engine.submit(0, b"x", 0.0)
    assert read(drain(engine)[0]).dst_id == 7
    with pytest.raises(ConfigError, match="dst_id = 256"):
        engine.reconfigure(dst_id=256)


@given(
    st.lists(st.tuples(st.integers(0, 5), st.integers(0, 900)), max_size=40),
    st.integers(40, 300),
    st.booleans(),
    st.integers(1, 27),
)
def test_every_message_leaves_whole_once_in_topic_order(
    messages: list[tuple[int, int]], packet_len: int, greedy: bool, min_fragment: int
) -> None:
    events: list[SenderEvent] = []
    engine = Sender(
        Registry.from_rows({f"t{number}": "a/B" for number in range(6)}),
        *paper_from(robot=1, packet_len=packet_len, greedy=greedy, min_fragment=min_fragment, queue_depth=0),
        rng=random.Random(1),
        observer=events.append,
    )
    sent = [(topic, bytes([number]) * size) for number, (topic, size) in enumerate(messages)]
    for topic, payload in sent:
        engine.submit(topic, payload, 0.0)
    got: dict[int, list[bytes]] = {}
    for data in drain(engine):
        packet = read(data)
        topics = [entry.topic_id for entry in packet.entries]
        assert greedy or len(topics) == len(set(topics))
        for entry in packet.entries:
            parts = got.setdefault(entry.topic_id, [])
            if entry.index == 0:
                parts.append(b"")
            parts[-1] += entry.payload
    for topic in range(6):
        assert got.get(topic, []) == [payload for owner, payload in sent if owner == topic]
    assert engine.idle
    assert sum(isinstance(event, Accepted) for event in events) == len(sent)
    assert sum(isinstance(event, SentPacket) for event in events) == engine.stats.packets


class Halving:
    """A codec that keeps every other byte, behind a byte that names it; its messages hold each byte twice."""

    def canonical(self, topic_id: int, payload: bytes) -> bytes:  # noqa: ARG002 - all topics are alike
        return bytes(byte for byte in payload[::2] for _ in range(2))

    def encode(self, topic_id: int, payload: bytes) -> bytes:
        return bytes([topic_id]) + payload[::2]

    def decode(self, topic_id: int, coded: bytes) -> bytes:
        assert coded[0] == topic_id
        return bytes(byte for byte in coded[1:] for _ in range(2))


def test_a_codec_shrinks_what_is_sent_and_events_keep_what_was_submitted() -> None:
    events: list[SenderEvent] = []
    engine = Sender(
        registry(2),
        *paper_from(robot=1, packet_len=64),
        codec=Halving(),
        rng=random.Random(0),
        observer=events.append,
    )
    message = bytes(byte for byte in range(50) for _ in range(2))
    engine.submit(1, message, 0.0)
    (data,) = drain(engine)
    packet = read(data)
    assert packet.compressed
    assert packet.entries[0].payload == b"\1" + bytes(range(50))
    assert isinstance(events[0], Accepted)
    assert events[0].payload == message
    sink = Receiver(registry(2), *paper_from(robot=0, packet_len=64), codec=Halving())
    assert delivered(sink.receive(AirPacket(data), 0.0)) == [message]


def test_what_the_graph_lost_before_submission_is_observed_once() -> None:
    events: list[SenderEvent] = []
    engine = Sender(registry(2), *paper_from(robot=1), rng=random.Random(0), observer=events.append)
    for total in (0, 2, 2, 5):
        engine.ledger.missed(1, total)
    assert events == [Missed(1, 2), Missed(1, 3)]
    assert (engine.stats.missed, engine.stats.submitted) == ({1: 5}, {})
    assert engine.idle


def test_a_message_that_fits_only_coded_is_sent() -> None:
    engine = Sender(registry(1), *paper_from(robot=1, packet_len=64), codec=Halving())
    engine.submit(0, bytes(255 * 51 + 100), 0.0)
    assert len(drain(engine)) == 129


def test_nothing_is_composed_before_it_is_asked_for() -> None:
    """What came last before the credit goes, whatever was waiting when the credit before was used."""
    engine = sender(rows=1, packet_len=64, queue_depth=1)
    engine.pace.use_credit()
    engine.submit(0, b"old", 0.0)
    assert engine.next_packet(0.0) is None
    engine.submit(0, b"new", 0.1)
    engine.pace.credit()
    data = data_of(engine.next_packet(0.1))
    assert data is not None
    assert read(data).entries[0].payload == b"new"


def test_a_plan_is_made_only_when_something_changed(monkeypatch: pytest.MonkeyPatch) -> None:
    engine = sender(rows=1, packet_len=64)
    made = []

    def plan(self: PaperScheduler, queues: Any, plan: Any = PaperScheduler.plan) -> Any:
        made.append(plan(self, queues))
        return made[-1]

    monkeypatch.setattr(PaperScheduler, "plan", plan)
    engine.submit(0, bytes(80), 0.0)
    for _ in range(5):
        engine.next_timeout()
    drain(engine)
    engine.next_timeout()
    assert len(made) == 3, "for each of two packets, and once to see that nothing is left"
