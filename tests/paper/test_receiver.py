"""Reassembly whatever the order, and a name for everything that does not arrive."""

from __future__ import annotations

import random
from collections import Counter

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gr_ros2.link import Delivered, Lost, Rejected
from gr_ros2.settings.robot import PublishOptions
from gr_ros2.wire.v0 import V0, EntryV0, PacketV0
from tests.link.engines import delivered, drain, receiver, sender, take


def packet(
    seq: int, *entries: EntryV0, src_id: int = 1, dst_id: int = 255, length: int = 64, compressed: bool = False
) -> bytes:
    return V0.encode(PacketV0(src_id, dst_id, seq, 1, entries, compressed=compressed), length)


def test_out_of_order_interleaved_and_duplicated() -> None:
    engines = [sender(packet_len=64, robot=robot, seed=robot) for robot in (1, 2)]
    messages = {}
    packets = []
    for engine in engines:
        for topic in range(3):
            message = bytes([engine.src_id, topic]) * 200
            messages[engine.src_id, topic] = message
            engine.submit(topic, message, 0.0)
        packets += drain(engine)
    packets += packets[:20]
    random.Random(3).shuffle(packets)
    sink = receiver(packet_len=64)
    got = {}
    for data in packets:
        for event in take(sink, data, 0.0):
            assert isinstance(event, Delivered)
            assert (event.src_id, event.topic_id) not in got
            got[event.src_id, event.topic_id] = event.payload
    assert got == messages
    assert sink.stats.dropped["duplicate"] == 20
    assert sink.held_bytes == 0


def test_messages_of_one_topic_may_interleave_on_a_clean_link() -> None:
    sink = receiver(packet_len=64)
    events = []
    for seq, (entry_id, index) in enumerate([(10, 0), (20, 0), (10, 1), (20, 1)]):
        events += take(sink, packet(seq, EntryV0(0, entry_id, index, 2, bytes([entry_id]))), 0.0)
    assert delivered(events) == [b"\x0a\x0a", b"\x14\x14"]


@pytest.mark.parametrize("step", range(256))
def test_any_id_is_taken_whatever_came_before_it(step: int) -> None:
    """A sender of random ids (the paper's) on a clean link: what is behind the newest id is older, or far ahead."""
    sink = receiver(packet_len=64)
    events = []
    for number, entry_id in enumerate([100, 100 + step & 255]):
        for index in range(3):
            events += take(sink, packet(number * 3 + index, EntryV0(0, entry_id, index, 3, bytes([number]))), 0.0)
    assert delivered(events) == [bytes(3), b"\x01\x01\x01"]


@pytest.mark.parametrize(
    "entry",
    [EntryV0(0, 5, 0, 3, b"new"), EntryV0(0, 5, 1, 2, b"new"), EntryV0(0, 5, 0, 1, b"new")],
    ids=["same index, other bytes", "other total", "single"],
)
def test_a_contradiction_begins_a_new_message(entry: EntryV0) -> None:
    sink = receiver(packet_len=64)
    assert take(sink, packet(0, EntryV0(0, 5, 0, 3, b"old")), 0.0) == []
    events = take(sink, packet(1, entry), 0.0)
    assert Lost(1, 0, "lost_fragments", 5) in events
    assert sink.stats.lost == Counter({(1, 0, "lost_fragments"): 1})


def test_a_fragment_that_says_other_flags_is_of_another_message() -> None:
    sink = receiver(packet_len=64)
    take(sink, packet(0, EntryV0(0, 5, 0, 2, b"a")), 0.0)
    events = take(sink, packet(1, EntryV0(0, 5, 1, 2, b"b"), compressed=True), 0.0)
    assert events == [Lost(1, 0, "lost_fragments", 5)]


def test_a_message_that_makes_no_progress_expires() -> None:
    sink = receiver(packet_len=64, reassembly_timeout_s=1.0)
    take(sink, packet(0, EntryV0(0, 5, 0, 3, b"a")), 0.0)
    assert sink.next_timeout() == pytest.approx(1.0)
    take(sink, packet(1, EntryV0(0, 5, 1, 3, b"b")), 0.9)
    assert sink.handle_timeout(1.5) == []
    assert sink.handle_timeout(1.9) == [Lost(1, 0, "expired", 5)]
    assert sink.next_timeout() is None
    assert sink.held_bytes == 0


def test_a_message_64_ids_behind_is_given_up_whatever_the_timeout() -> None:
    sink = receiver(packet_len=64, reassembly_timeout_s=1e9)
    take(sink, packet(0, EntryV0(0, 5, 0, 2, b"a")), 0.0)
    events = []
    for number in range(1, 64):
        events += take(sink, packet(number, EntryV0(0, 5 + number, 0, 1, b"x")), 0.0)
    assert not any(isinstance(event, Lost) for event in events)
    assert Lost(1, 0, "lost_fragments", 5) in take(sink, packet(64, EntryV0(0, 69, 0, 1, b"x")), 0.0)


def test_a_message_is_given_up_when_64_ids_would_have_passed_unseen() -> None:
    sink = receiver(packet_len=64, reassembly_timeout_s=1e9)
    for number in range(40):
        take(sink, packet(number, EntryV0(0, number, 0, 1, b"x")), number * 0.1)
    take(sink, packet(40, EntryV0(0, 40, 0, 2, b"a")), 4.0)
    # 256 messages later the id comes round, and the other fragment would fit.
    events = take(sink, packet(41 + 100, EntryV0(0, 40, 1, 2, b"b")), 4.0 + 25.6)
    assert events == [Lost(1, 0, "lost_fragments", 40)]


def test_own_packets_and_those_for_others_are_counted_and_dropped() -> None:
    sink = receiver(packet_len=64, robot=7)
    entry = EntryV0(0, 5, 0, 1, b"a")
    assert take(sink, packet(0, entry, src_id=7), 0.0) == []
    assert take(sink, packet(1, entry, dst_id=8), 0.0) == []
    assert delivered(take(sink, packet(2, entry, dst_id=7), 0.0)) == [b"a"]
    assert delivered(take(sink, packet(3, EntryV0(0, 6, 0, 1, b"a")), 0.0)) == [b"a"]
    assert sink.stats.dropped == Counter(own=1, not_for_us=1)


def test_sources_beyond_the_bound_wait_until_one_has_gone_silent() -> None:
    sink = receiver(packet_len=64, max_sources=2)
    for src_id in (1, 2, 3):
        take(sink, packet(0, EntryV0(0, 5, 0, 1, b"a"), src_id=src_id), 0.0)
    assert sink.stats.dropped["max_sources"] == 1
    assert delivered(take(sink, packet(0, EntryV0(0, 5, 0, 1, b"b"), src_id=3), 100.0)) == [b"b"]


def test_memory_is_bounded_oldest_incomplete_first() -> None:
    sink = receiver(rows=1, packet_len=4095, max_source_bytes=10_000, reassembly_timeout_s=1e9)
    events = []
    for number in range(5):
        events += take(sink, packet(number, EntryV0(0, number, 0, 2, bytes(4000)), length=4095), 0.0)
        assert sink.held_bytes <= 10_000
    assert events == [Lost(1, 0, "memory", 0), Lost(1, 0, "memory", 1), Lost(1, 0, "memory", 2)]


def test_what_the_receiver_cannot_undo_is_unsupported_and_never_delivered() -> None:
    sink = receiver(packet_len=64)
    take(sink, packet(0, EntryV0(0, 5, 0, 2, b"a"), compressed=True), 0.0)
    events = take(sink, packet(1, EntryV0(0, 5, 1, 2, b"b"), compressed=True), 0.0)
    assert events == [Lost(1, 0, "unsupported", 5)]


def test_a_topic_id_beyond_the_registry_is_counted() -> None:
    sink = receiver(rows=2, packet_len=64)
    assert take(sink, packet(0, EntryV0(9, 0, 0, 1, b"a"), EntryV0(1, 0, 0, 1, b"b")), 0.0) == [
        Delivered(1, 1, b"b", 0, 0)
    ]
    assert sink.stats.dropped == Counter(unknown_topic=1)


def test_a_repeat_of_a_transient_local_message_is_not_delivered_again() -> None:
    sink = receiver(packet_len=64, publish_topics={"t0": PublishOptions(durability="transient_local")})
    events = []
    for seq, payload in enumerate([b"A", b"A", b"B", b"A"]):
        events += take(sink, packet(seq, EntryV0(0, seq, 0, 1, payload), EntryV0(1, seq, 0, 1, payload)), 0.0)
    assert [(event.topic_id, event.payload) for event in events if isinstance(event, Delivered)] == [
        (0, b"A"), (1, b"A"), (1, b"A"), (0, b"B"), (1, b"B"), (0, b"A"), (1, b"A"),
    ]  # fmt: skip
    assert sink.stats.repeats == 1


def test_what_was_not_published_is_lost_and_its_repeat_comes_out() -> None:
    sink = receiver(packet_len=64, publish_topics={"t0": PublishOptions(durability="transient_local")})
    (event,) = take(sink, packet(0, EntryV0(0, 0, 0, 1, b"A")), 0.0)
    assert isinstance(event, Delivered)
    assert sink.unpublished(event) == Lost(1, 0, "publish_failed", 0)
    assert sink.stats.lost == Counter({(1, 0, "publish_failed"): 1})
    assert take(sink, packet(1, EntryV0(0, 1, 0, 1, b"A")), 0.0) == [Delivered(1, 0, b"A", 0, 1)]
    assert take(sink, packet(2, EntryV0(0, 2, 0, 1, b"A")), 0.0) == []
    assert (sink.stats.delivered[1, 0], sink.stats.repeats) == (2, 1)


def test_loss_estimates_come_from_gaps() -> None:
    engine, sink = sender(packet_len=64, queue_depth=0), receiver(packet_len=64)
    for _ in range(100):
        engine.submit(0, bytes(100), 0.0)
    packets = drain(engine)
    kept = [data for number, data in enumerate(packets) if number % 10 not in (0, 1) or number == 0]
    for data in kept:
        take(sink, data, 0.0)
    assert sink.stats.packet_loss_est == pytest.approx(len(packets) - len(kept), abs=2)
    assert sink.stats.message_loss_est + sink.stats.delivered[1, 0] == pytest.approx(100, abs=2)


@pytest.mark.parametrize("start", range(0, 256, 15))
def test_a_restart_is_no_loss(start: int) -> None:
    sink = receiver(packet_len=64)
    for seq in range(200):
        take(sink, packet(seq % 256, EntryV0(0, seq, 0, 1, b"a")), seq * 0.03)
    for number in range(200):
        take(sink, packet((start + number) % 256, EntryV0(0, number, 0, 1, b"b")), 10.0 + number * 0.03)
    near = start - 200 if 200 < start <= 215 else 0
    assert (sink.stats.packet_loss_est, sink.stats.unknown_gaps) == (near, not near and start != 200)


@given(st.lists(st.binary(max_size=80), max_size=60), st.integers(14, 80))
def test_garbage_is_rejected_by_name_and_loses_nothing_else(garbage: list[bytes], packet_len: int) -> None:
    engine, sink = sender(packet_len=packet_len, min_fragment=1), receiver(packet_len=packet_len, min_fragment=1)
    engine.submit(0, bytes(range(100)), 0.0)
    good = drain(engine)
    events = []
    for number in range(max(len(garbage), len(good))):
        for data in (*garbage[number : number + 1], *good[number : number + 1]):
            events += take(sink, data, 0.0)
    assert delivered(events) == [bytes(range(100))]
    rejected = [event for event in events if isinstance(event, Rejected)]
    assert len(rejected) == sum(sink.stats.rejected.values()) == len(garbage)


@pytest.mark.slow
@given(st.data())
def test_forged_packets_never_raise_and_memory_stays_bounded(data: st.DataObject) -> None:
    sink = receiver(rows=4, packet_len=40, max_source_bytes=4096, max_bytes=8192, max_sources=3)
    byte = st.integers(0, 255)
    now = 0.0
    for _ in range(data.draw(st.integers(0, 60))):
        total = data.draw(st.integers(1, 255))
        entry = EntryV0(
            data.draw(st.integers(0, 5)),
            data.draw(byte),
            data.draw(st.integers(0, total - 1)),
            total,
            data.draw(st.binary(max_size=26)),
        )
        now += data.draw(st.sampled_from([0.0, 0.01, 0.5, 2.0, 100.0]))
        take(sink, packet(data.draw(byte), entry, src_id=data.draw(st.integers(0, 5)), length=40), now)
        assert sink.held_bytes <= 8192
    sink.handle_timeout(now + 10)
    assert sink.held_bytes == 0


def test_a_fast_stream_that_hangs_for_a_moment_loses_nothing() -> None:
    engine, sink = sender(packet_len=64, queue_depth=0), receiver(packet_len=64)
    now = 0.0
    events = []
    for number in range(60):
        engine.submit(0, bytes([number]) * 500, now)
        for position, data in enumerate(drain(engine, now)):
            # 20,000 packets/s, so 192 ids pass in 0.1 s; yet a busy machine may stop for longer than that.
            now += 0.4 if (number, position) == (40, 5) else 5e-5
            events += take(sink, data, now)
    assert len(delivered(events)) == 60
    assert not sink.stats.lost
