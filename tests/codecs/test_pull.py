"""When a message is coded, and into how many bytes."""

from __future__ import annotations

from itertools import pairwise
from math import inf

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gr_ros2.codecs.pull import KEY_S, LEAST_BYTES, PART, PATIENCE_S, FramePull
from gr_ros2.link.frames import FrameState

RATE = 10_000.0
PERIOD = 0.1
FREE = FrameState(RATE, 0, 0.0, 0.0, False, 0.1, 1, True)
"""All that has left is confirmed."""


def running(frames: int = 3, **settings: float) -> tuple[FramePull, float]:
    """A topic with a message each 0.1 s whose frames were confirmed at once, and the time of the newest message."""
    pull = FramePull(**settings)
    for number in range(frames):
        pull.offer(b"old", number * PERIOD)
        if pull.pull(number * PERIOD, FREE):
            pull.done()
    pull.offer(b"new", frames * PERIOD)
    return pull, frames * PERIOD


def test_the_newest_message_is_coded_into_what_is_free_until_the_next() -> None:
    pull, now = running()
    request = pull.pull(now, FREE)
    assert request is not None
    assert (request.message, request.came) == (b"new", now)
    assert request.budget == pytest.approx(PART * RATE * PERIOD, abs=1)
    assert not request.key


def test_several_topics_share_what_is_free() -> None:
    pull, now = running()
    request = pull.pull(now, FREE, 0.25)
    assert request is not None
    assert request.budget == pytest.approx(PART * RATE * PERIOD / 4, abs=1)


def test_a_channel_whose_rate_is_not_known_sets_no_budget() -> None:
    pull, now = running()
    assert pull.pull(now, FREE._replace(rate=inf, waiting=1)) is None
    request = pull.pull(now, FREE._replace(rate=inf))
    assert request is not None
    assert request.budget is None


def test_a_message_that_is_taken_late_has_the_bytes_that_are_left() -> None:
    pull, now = running()
    request = pull.pull(now + 0.04, FREE)
    assert request is not None
    assert request.budget == pytest.approx(PART * RATE * 0.06, abs=1)


def test_a_newer_message_takes_the_place_of_one_that_was_not_coded() -> None:
    pull, now = running()
    assert pull.offer(b"newer", now + PERIOD)
    request = pull.pull(now + PERIOD, FREE)
    assert request is not None
    assert request.message == b"newer"
    assert pull.pull(now + PERIOD, FREE) is None
    pull.done()
    assert not pull.offer(b"last", now + 2 * PERIOD)


def test_it_waits_until_the_frame_before_will_have_left_when_coding_is_done() -> None:
    pull, now = running(coding_s=0.008)
    assert pull.pull(now, FREE._replace(waiting=81)) is None
    request = pull.pull(now, FREE._replace(waiting=80))
    assert request is not None
    assert request.budget == pytest.approx(PART * RATE * PERIOD - 80, abs=1)


def test_on_a_slow_link_the_next_is_coded_while_a_small_one_waits() -> None:
    """All leave in one packet, and what is shown is the newest."""
    slow, most = FREE._replace(rate=500.0), 4 * LEAST_BYTES
    pull, now = running()
    assert pull.pull(now, slow._replace(waiting=most + 1)) is None
    request = pull.pull(now, slow._replace(waiting=most))
    assert request is not None
    assert request.budget == LEAST_BYTES


def test_one_frame_is_coded_at_a_time() -> None:
    pull, now = running()
    assert pull.pull(now, FREE)
    pull.offer(b"next", now + PERIOD)
    assert pull.pull(now + PERIOD, FREE) is None
    pull.done()
    assert pull.pull(now + PERIOD, FREE)


def test_on_a_channel_that_others_fill_frames_come_as_seldom_as_there_is_room_for_them() -> None:
    """Otherwise frames of the least size would take most of a slow channel from the others."""
    pull, rate, sizes = FramePull(), 110.0, []
    for number in range(1000):
        pull.offer(b"message", number * PERIOD)
        if request := pull.pull(number * PERIOD, FREE._replace(rate=rate)):
            sizes.append(request.budget)
            pull.done()
    assert set(sizes[1:]) == {LEAST_BYTES}
    assert 0.8 * rate < sum(sizes[1:]) / (1000 * PERIOD) <= rate


def test_a_longest_rate_leaves_messages_out() -> None:
    pull = FramePull(period_s=0.2)
    taken = []
    for number in range(20):
        pull.offer(b"message", number * PERIOD)
        if request := pull.pull(number * PERIOD, FREE):
            taken.append((number, request.budget))
            pull.done()
    assert [number for number, _ in taken] == list(range(0, 20, 2))
    assert taken[-1][1] == pytest.approx(PART * RATE * 0.2, abs=1)


def test_a_longest_rate_holds_where_the_air_is_free_between_two_messages() -> None:
    pull, taken = FramePull(period_s=0.2), 0
    for step in range(3000):
        if step % 67 == 0:
            pull.offer(b"message", step / 1000)
        if step % 13 == 0 and pull.pull(step / 1000, FREE):
            taken += 1
            pull.done()
    assert 14 <= taken <= 16


def test_none_is_begun_while_all_robots_have_lacked_one_for_long_and_are_silent() -> None:
    pull, now = running()
    assert pull.pull(now, FREE._replace(lacked=PATIENCE_S + 0.01, behind=1.0, silent=True)) is None
    assert pull.pull(now, FREE._replace(lacked=PATIENCE_S - 0.01, behind=0.1, silent=True))


def test_when_somebody_is_heard_again_a_key_frame_goes_on() -> None:
    pull, now = running()
    stuck = FREE._replace(lacked=3.0, behind=3.0, silent=True)
    assert pull.pull(now + 3, stuck) is None
    request = pull.pull(now + 3, stuck._replace(silent=False))
    assert request is not None
    assert request.key
    pull.done()
    pull.offer(b"next", now + 3.1)
    assert pull.pull(now + 3.1, stuck._replace(silent=False)) is None


def test_a_robot_that_cannot_follow_gets_key_frames_and_holds_nobody_back() -> None:
    pull, now = running()
    keys = []
    for number in range(60):
        at = now + number * PERIOD
        pull.offer(b"message", at)
        request = pull.pull(at, FREE._replace(lacked=0.1, behind=0.6))
        assert request is not None
        keys += [at] * request.key
        pull.done()
    assert len(keys) == 3


def test_a_key_frame_follows_whoever_joins_one_in_a_while() -> None:
    pull, now = running()
    keys = []
    for number in range(60):
        at = now + number * PERIOD
        pull.offer(b"message", at)
        request = pull.pull(at, FREE._replace(joined=number))
        assert request is not None
        keys += [at] * request.key
        pull.done()
    assert len(keys) == 3
    assert min(after - before for before, after in pairwise(keys)) >= KEY_S - 1e-9


def test_a_key_frame_that_could_not_be_coded_is_asked_for_again() -> None:
    pull = FramePull()
    pull.offer(b"broken", 0.0)
    request = pull.pull(0.0, FREE)
    assert request is not None
    assert request.key
    pull.done(request)
    pull.offer(b"whole", PERIOD)
    request = pull.pull(PERIOD, FREE)
    assert request is not None
    assert request.key


def test_the_first_frame_is_a_key_frame_and_without_reports_they_come_again() -> None:
    pull = FramePull()
    keys = []
    for number in range(50):
        pull.offer(b"message", number * PERIOD)
        request = pull.pull(number * PERIOD, FREE._replace(reports=False))
        assert request is not None
        pull.done()
        keys += [number] * request.key
    assert keys == [0, 20, 40]


@given(st.lists(st.tuples(st.sampled_from(["offer", "pull", "done", "join"]), st.floats(0, 9), st.integers(0, 99))))
def test_budgets_are_bounded_whatever_happens(events: list[tuple[str, float, int]]) -> None:
    pull, now, coding, joined = FramePull(), 0.0, False, 0
    for event, since, waiting in events * 5:
        now += 0.013
        if event == "offer":
            pull.offer(b"message", now)
        elif event == "pull":
            request = pull.pull(now, FrameState(RATE, waiting, since, since, since > 7, 0.1, joined, since < 5))
            assert request is None or (not coding and LEAST_BYTES <= (request.budget or 0) <= RATE * 20)
            coding = coding or request is not None
        elif event == "done" and coding:
            coding = False
            pull.done()
        elif event == "join":
            joined += 1
