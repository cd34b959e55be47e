"""What was late is kept as moments, however many packets are in one."""

from __future__ import annotations

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gr_ros2.link.lateness import LATE_S, Lateness


def test_small_lateness_is_measured_and_no_moment() -> None:
    lateness = Lateness()
    lateness.happened(1.0, 1.0 + LATE_S / 2)
    lateness.happened(2.0, 1.9)
    assert lateness.worst == pytest.approx(LATE_S / 2)
    assert lateness.moments == []


def test_moments_that_touch_are_one() -> None:
    lateness = Lateness()
    for due, now in ((1.0, 1.5), (1.2, 1.5), (1.5, 1.7), (3.0, 3.1), (5.0, 5.2), (2.9, 5.3)):
        lateness.happened(due, now)
    assert lateness.moments == [(1.0, 1.7), (2.9, 5.3)]
    assert lateness.worst == pytest.approx(2.4)


@given(st.lists(st.tuples(st.floats(0, 3), st.floats(0, 0.5))))
def test_moments_are_apart_and_cover_all_that_was_late(steps: list[tuple[float, float]]) -> None:
    lateness, now, late = Lateness(), 10.0, []
    for ago, passes in steps:
        now += passes
        lateness.happened(now - ago, now)
        if now - (now - ago) >= LATE_S:
            late.append((now - ago, now))
    moments = lateness.moments
    assert all(before[1] < after[0] for before, after in pairwise(moments))
    assert all(any(due <= a and b <= happened for due, happened in moments) for a, b in late)
    assert len(moments) <= len(late)
