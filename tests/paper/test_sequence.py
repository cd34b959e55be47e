"""Where a packet belongs by its sequence number, and when it cannot belong."""

from __future__ import annotations

import pytest

from gr_ros2.paper.sequence import NEAR, Arrival, CountRate, SequenceTracker


def place(tracker: SequenceTracker, seq: int, now: float = 0.0, data: bytes | None = None) -> Arrival:
    return tracker.place(seq, data if data is not None else bytes([seq]), now).arrival


def test_in_order_around_the_wrap() -> None:
    tracker = SequenceTracker()
    arrivals = [tracker.place(seq % 256, bytes([seq % 256]), 0.0) for seq in range(250, 600)]
    assert {placed.arrival for placed in arrivals} == {Arrival.NEXT}
    assert [placed.position for placed in arrivals] == list(range(250, 600))


def test_a_gap_is_counted_and_a_late_packet_put_where_it_belongs() -> None:
    tracker = SequenceTracker()
    tracker.place(254, b"a", 0.0)
    gap = tracker.place(2, b"b", 0.0)
    assert (gap.arrival, gap.missing, gap.position) == (Arrival.GAP, 3, 258)
    late = tracker.place(0, b"c", 0.0)
    assert (late.arrival, late.position) == (Arrival.LATE, 256)
    assert place(tracker, 3) is Arrival.NEXT


def test_duplicates_are_the_same_number_and_bytes_within_64_packets() -> None:
    tracker = SequenceTracker()
    for seq in range(80):
        place(tracker, seq)
    assert place(tracker, 79) is Arrival.DUPLICATE
    assert place(tracker, 20) is Arrival.DUPLICATE
    assert place(tracker, 10) is Arrival.LATE


def test_other_bytes_under_a_recent_number_are_a_restart() -> None:
    tracker = SequenceTracker()
    for seq in range(100):
        place(tracker, seq)
    assert place(tracker, 40, data=b"other") is Arrival.RESET
    assert place(tracker, 41, data=b"other too") is Arrival.NEXT
    assert place(tracker, 100) is Arrival.GAP


def test_a_silence_in_which_64_packets_would_have_passed_is_a_reset_unless_the_next_number_follows() -> None:
    steady, outage = SequenceTracker(), SequenceTracker()
    for seq in range(100):
        place(steady, seq, seq * 0.01)
        place(outage, seq, seq * 0.01)
    assert place(steady, 100, 3.0) is Arrival.NEXT
    assert place(outage, 130, 3.0) is Arrival.RESET


def test_a_packet_later_than_half_a_second_at_the_recent_pace_is_a_reset() -> None:
    tracker = SequenceTracker()
    for seq in [*range(60), *range(61, 100)]:
        place(tracker, seq, seq * 0.01)
    assert place(tracker, 60, 1.0) is Arrival.LATE
    tracker = SequenceTracker()
    for seq in [*range(20), *range(21, 100)]:
        place(tracker, seq, seq * 0.01)
    assert place(tracker, 20, 1.0) is Arrival.RESET


@pytest.mark.parametrize(
    ("packets", "pause", "step", "missing"),
    [
        (100, 0.01, 61, 60),
        (100, 3.0, 61, None),
        (100, 3.0, -61, None),
        (100, 3.0, 0, None),
        (100, 3.0, 3, 2),
        (30, 0.01, 61, None),
        (30, 0.01, 3, 2),
    ],
    ids=[
        "loss",
        "silence",
        "a silence, and behind",
        "a silence of 256",
        "near",
        "no pace yet",
        "no pace yet, and near",
    ],
)
def test_what_is_missing_is_told_only_where_it_is_known(
    packets: int, pause: float, step: int, missing: int | None
) -> None:
    tracker = SequenceTracker()
    for seq in range(packets):
        place(tracker, seq, seq * 0.01)
    last = packets - 1
    assert tracker.place((last + step) % 256, b"new", last * 0.01 + pause).missing == missing


def test_a_number_that_a_slow_sender_cannot_have_come_to_tells_nothing() -> None:
    tracker = SequenceTracker()
    for seq in range(100):
        place(tracker, seq, seq * 1.0)
    assert tracker.place(99 + NEAR, b"a", 100.0).missing == NEAR - 1
    placed = tracker.place(99 + NEAR + 61, b"b", 101.0)
    assert (placed.arrival, placed.missing) == (Arrival.GAP, None)


def test_pace_is_believed_only_after_enough() -> None:
    pace = CountRate(window=8, least=4)
    assert pace.duration(10) == float("inf")
    for step in range(20):
        pace.observe(step * 0.5, 2)
    assert pace.duration(10) == 2.5
