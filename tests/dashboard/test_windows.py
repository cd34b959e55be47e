"""Bounded memories: what they say, and that they are bounded."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gr_ros2.dashboard.windows import AgeMeter, PathComparison, PathWindow, Rate
from gr_ros2_lab.record.metrics import age


def test_a_rate_forgets_what_is_older_than_its_window() -> None:
    rate = Rate()
    for step in range(100):
        rate.add(step / 10, size=3)
    assert rate.totals(9.99) == (50, 150)
    assert rate.totals(12.49) == (25, 75)
    assert rate.totals(100.0) == (0, 0)
    assert Rate().totals(1.0) == (0, 0)


def test_a_rate_takes_what_comes_a_little_late() -> None:
    rate = Rate()
    rate.add(10.0)
    rate.add(9.9)
    assert rate.totals(10.0) == (2, 0)


@given(
    st.lists(st.tuples(st.floats(0, 100), st.floats(0, 5)), min_size=1, max_size=30),
    st.floats(0.1, 10),
)
def test_the_age_is_that_of_the_result(messages: list[tuple[float, float]], rest: float) -> None:
    delivered = sorted((t_sent + latency, t_sent) for t_sent, latency in messages)
    meter = AgeMeter()
    for now, t_sent in delivered:
        meter.delivered(t_sent, now)
    end = delivered[-1][0] + rest
    expected = age(np.array([t for _, t in delivered]), np.array([now for now, _ in delivered]), end)
    measured = meter.read(end)
    assert expected is not None
    assert measured is not None
    assert measured[0] == pytest.approx(end - max(t for _, t in delivered))
    assert measured[1:] == pytest.approx((expected.mean, expected.peak), abs=1e-9)


def test_no_age_before_the_first_delivery() -> None:
    assert AgeMeter().read(1.0) is None


def test_a_trail_is_thinned_bounded_and_ends_where_it_is() -> None:
    trail = PathWindow(points=10, apart_s=1.0)
    assert [len(axis) for axis in trail.xy()] == [0, 0]
    for step in range(1000):
        trail.add(step / 10, (step, -step))
    x, y = trail.xy()
    assert x.tolist() == [*range(900, 1000, 10), 999]
    assert y.tolist() == [-value for value in x]


def test_a_belief_needs_both_sides() -> None:
    belief = PathComparison(points=10, apart_s=0.0)
    belief.moved(0.0, (0, 0))
    assert belief.error() is None
    belief.heard(1.0, (0, 0))
    belief.moved(2.0, (3, 4))
    assert belief.error() == 5
    t, errors = belief.errors()
    assert (t.tolist(), errors.tolist()) == ([2.0], [5.0])
