"""When a message is coded, and into how many bytes."""

from __future__ import annotations

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gr_ros2.codecs.pull import (
    KEY_S,
    LEAST_BYTES,
    MOST_UNCONFIRMED,
    PATIENCE_S,
    WINDOW_S,
    FramePull,
    FreeRate,
)

CAPACITY = 10_000.0
PERIOD = 0.1


def running(frames: int = 3, **settings: float | bool) -> tuple[FramePull, float]:
    """A topic with a message each 0.1 s whose frames were confirmed at once, and the time of the newest message."""
    pull = FramePull(FreeRate(CAPACITY), **settings)  # type: ignore[arg-type]
    for number in range(frames):
        pull.offer(b"old", number * PERIOD)
        if pull.pull(number * PERIOD, 0):
            pull.coded(number, number * PERIOD)
            pull.confirmed(number)
    pull.offer(b"new", frames * PERIOD)
    return pull, frames * PERIOD


def test_the_newest_message_is_coded_into_what_is_free_until_the_next() -> None:
    pull, now = running()
    request = pull.pull(now, 0)
    assert request is not None
    assert request.message == b"new"
    assert request.budget == pytest.approx(CAPACITY * PERIOD, abs=1)
    assert not request.key


def test_a_message_that_is_taken_late_has_the_bytes_that_are_left() -> None:
    pull, now = running()
    request = pull.pull(now + 0.04, 0)
    assert request is not None
    assert request.budget == pytest.approx(CAPACITY * 0.06, abs=1)


def test_a_newer_message_takes_the_place_of_one_that_was_not_coded() -> None:
    pull, now = running()
    pull.offer(b"newer", now + PERIOD)
    request = pull.pull(now + PERIOD, 0)
    assert request is not None
    assert request.message == b"newer"
    assert pull.superseded == 1
    assert pull.pull(now + PERIOD, 0) is None


def test_it_waits_until_the_frame_before_will_have_left_when_coding_is_done() -> None:
    pull, now = running(coding_s=0.008)
    assert pull.pull(now, 81) is None
    request = pull.pull(now, 80)
    assert request is not None
    assert request.budget == pytest.approx(CAPACITY * PERIOD - 80, abs=1)


def test_one_frame_is_coded_at_a_time() -> None:
    pull, now = running()
    assert pull.pull(now, 0)
    pull.offer(b"next", now + PERIOD)
    assert pull.pull(now + PERIOD, 0) is None
    pull.failed()
    assert pull.pull(now + PERIOD, 0)


def test_a_longest_rate_leaves_messages_out() -> None:
    pull = FramePull(FreeRate(CAPACITY), period_s=0.2)
    taken = []
    for number in range(20):
        pull.offer(b"message", number * PERIOD)
        if request := pull.pull(number * PERIOD, 0):
            taken.append((number, request.budget))
            pull.coded(number, number * PERIOD)
            pull.confirmed(number)
    assert [number for number, _ in taken] == list(range(0, 20, 2))
    assert taken[-1][1] == pytest.approx(CAPACITY * 0.2, abs=1)


def test_none_is_begun_while_one_is_unconfirmed_for_long() -> None:
    pull, now = running()
    assert pull.pull(now, 0)
    pull.coded(77, now)
    pull.offer(b"next", now + PERIOD)
    assert pull.pull(now + PATIENCE_S, 0)
    pull.coded(78, now + PATIENCE_S)
    pull.offer(b"last", now + PATIENCE_S + PERIOD)
    assert pull.pull(now + PATIENCE_S + PERIOD, 0) is None
    pull.confirmed(77)
    assert pull.pull(now + PATIENCE_S + PERIOD, 0)


@pytest.mark.parametrize("event", ["broken", "joined"])
def test_a_key_frame_follows_what_breaks_the_chain_one_in_a_while(event: str) -> None:
    pull, now = running()
    keys = []
    for number in range(60):
        at = now + number * PERIOD
        pull.offer(b"message", at)
        getattr(pull, event)()
        request = pull.pull(at, 0)
        assert request is not None
        keys += [at] * request.key
        pull.coded(number, at)
        pull.confirmed(number)
    assert len(keys) == 3
    assert min(after - before for before, after in pairwise(keys)) >= KEY_S - 1e-9


def test_the_first_frame_is_a_key_frame_and_without_reports_they_come_again() -> None:
    pull = FramePull(FreeRate(CAPACITY), reports=False)
    keys = []
    for number in range(50):
        pull.offer(b"message", number * PERIOD)
        request = pull.pull(number * PERIOD, 0)
        assert request is not None
        pull.coded(number, number * PERIOD)
        keys += [number] * request.key
    assert keys == [0, 20, 40]


def test_nothing_waits_for_receivers_that_are_silent() -> None:
    pull, now = running()
    assert pull.pull(now, 0)
    pull.coded(5, now)
    pull.silent()
    pull.offer(b"next", now + 2)
    assert pull.pull(now + 2, 0)


def test_the_free_rate_is_what_others_leave_of_the_last_seconds() -> None:
    free = FreeRate(1000.0)
    assert free.rate(0) == 1000
    for number in range(40):
        free.left(number * 0.1, 30)
    assert free.rate(4.0) == pytest.approx(700, rel=0.06)
    for number in range(40):
        free.left(4 + number * 0.1, 500)
    assert free.rate(8.0) == 100
    free.left(8 + 2 * WINDOW_S, 0)
    assert free.rate(8 + 2 * WINDOW_S) == 1000


@given(st.lists(st.sampled_from(["offer", "pull", "coded", "failed", "confirm", "broken", "joined", "silent"])))
def test_memory_is_bounded_and_budgets_are_whatever_happens(events: list[str]) -> None:
    pull, now, coding, name = FramePull(FreeRate(CAPACITY)), 0.0, False, 0
    for event in events * 5:
        now += 0.013
        if event == "offer":
            pull.offer(b"message", now)
        elif event == "pull":
            request = pull.pull(now, 0)
            assert request is None or (not coding and LEAST_BYTES <= request.budget <= CAPACITY * 20)
            coding = coding or request is not None
        elif event == "coded" and coding:
            name, coding = name + 1, False
            pull.coded(name, now)
        elif event == "failed" and coding:
            coding = False
            pull.failed()
        elif event == "confirm":
            pull.confirmed(name)
        elif event in ("broken", "joined", "silent"):
            getattr(pull, event)()
        assert len(pull._unconfirmed) <= MOST_UNCONFIRMED
