"""A watcher that stood still itself accuses nobody."""

from __future__ import annotations

from math import inf
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gr_ros2.core import watch as watching
from gr_ros2.core.watch import Watch, wait_until

LOOKS = st.lists(st.tuples(st.floats(0, 100), st.floats(0, 100) | st.just(inf)), min_size=1)


def test_what_stands_still_under_a_watcher_that_runs_grows_old() -> None:
    watch = Watch(1.0)
    assert [watch.still_s(7, 0.5 * n) for n in range(5)] == [0.0, 0.5, 1.0, 1.5, 2.0]
    assert watch.still_s(8, 2.5) == 0.0
    assert watch.still_s(None, 3.0) == 0.0


def test_the_time_for_which_the_watcher_stood_still_itself_does_not_count() -> None:
    watch = Watch(1.0)
    assert watch.age(0.0, 0.0) == 0.0
    assert watch.age(12.0, 12.0) == 1.0
    assert watch.age(12.5, 12.5) == 1.5
    assert watch.age(0.1, 13.0) == 0.1


@given(LOOKS)
def test_an_age_is_never_above_what_the_clock_says_nor_above_what_was_watched(looks: list[tuple[float, float]]) -> None:
    watch, now, before = Watch(1.0), 0.0, 0.0
    for gap, told in looks:
        now += gap
        age = watch.age(told, now)
        assert 0 <= age <= told
        assert age <= before + min(gap, 1.0) + 1e-9
        before = age


@given(st.lists(st.floats(0.01, 1.0), min_size=1))
def test_without_a_pause_it_is_what_the_clock_says(gaps: list[float]) -> None:
    watch, now = Watch(1.0), 0.0
    watch.age(0.0, now)
    for gap in gaps:
        now += gap
        assert watch.age(now, now) == pytest.approx(now)


def test_what_comes_after_a_freeze_is_waited_for_as_if_there_had_been_none(monkeypatch: pytest.MonkeyPatch) -> None:
    now, pauses = [0.0], [0.5, 100.0, 0.5, 0.5]
    monkeypatch.setattr(watching, "time", SimpleNamespace(monotonic=lambda: now[0]))

    def pause(longest_s: float) -> None:
        assert longest_s <= 1.0
        now[0] += pauses.pop(0)

    assert wait_until(lambda: not pauses, 5.0, pause)
    pauses[:] = [1.0] * 10
    assert not wait_until(lambda: not pauses, 5.0, pause)
    assert len(pauses) == 5, "without a freeze it is the time of the clock"
    assert not wait_until(lambda: False, 0.0, pause)
