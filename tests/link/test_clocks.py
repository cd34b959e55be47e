"""Another robot's clock: what answers tell of it, and when it was set."""

from __future__ import annotations

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gr_ros2.link.clocks import DRIFT, OtherClock

WAYS = st.lists(st.tuples(st.floats(0, 0.5), st.floats(0, 0.5)), min_size=1, max_size=30)


@given(WAYS, st.floats(-1e6, 1e6), st.floats(-DRIFT / 2, DRIFT / 2))
def test_the_offset_lies_within_its_bounds_whatever_the_ways_take(
    ways: list[tuple[float, float]], ahead_s: float, drift: float
) -> None:
    """Asymmetric ways and a crystal that drifts change no bound, and count as no jump."""
    clock = OtherClock()
    for number, (there, back) in enumerate(ways):
        now = 10.0 * number
        true = ahead_s + drift * now
        clock.answered(true + (there - back) / 2, there + back, now)
        found = clock.at(now)
        assert found is not None
        assert abs(found.ahead_s - true) <= found.error_s + 1e-6
        assert found.error_s <= (there + back) / 2 + 1e-9, "no answer makes it worse than itself"
    assert clock.at(0.0).jumps == 0  # type: ignore[union-attr]


def test_a_clock_that_was_set_is_said_and_believed() -> None:
    draw, clock = random.Random(1), OtherClock()
    for number in range(100):
        there, back = draw.uniform(0.01, 0.1), draw.uniform(0.01, 0.1)
        ahead_s = 1.0 if number < 50 else 4.0
        clock.answered(ahead_s + (there - back) / 2, there + back, number * 2.0)
    found = clock.at(200.0)
    assert found is not None
    assert (found.jumps, found.ahead_s) == (1, pytest.approx(4.0, abs=found.error_s))
    assert found.jumped_s == pytest.approx(3.0, abs=0.2)


def test_this_robots_own_clock_is_no_jump_of_the_other() -> None:
    clock = OtherClock()
    assert clock.at(0.0) is None
    clock.answered(2.0, 0.01, 0.0)
    clock.own_was_set(1.5)
    clock.answered(0.5, 0.01, 1.0)
    found = clock.at(1.0)
    assert found is not None
    assert (found.jumps, found.ahead_s) == (0, 0.5)


def test_an_old_answer_counts_less() -> None:
    clock = OtherClock()
    clock.answered(1.0, 0.002, 0.0)
    late = clock.at(3600.0)
    assert late is not None
    assert late.error_s == pytest.approx(0.001 + 3600 * DRIFT)
    clock.answered(1.05, 0.1, 3600.0)
    assert clock.at(3602.0) == pytest.approx((1.05, 0.05 + 2 * DRIFT, 0, 0.0, 2, 1.05, 0.05, 2.0))


def test_a_clock_that_is_adjusted_was_not_set() -> None:
    clock = OtherClock()
    for number in range(100):
        clock.answered(number * 10 * 4e-4, 0.001, number * 10.0)
    found = clock.at(990.0)
    assert found is not None
    assert (found.jumps, found.answers) == (0, 100)
    assert found.ahead_s == pytest.approx(990 * 4e-4, abs=0.001 + 10 * 4e-4)
