"""A computer that is too slow is told from an air that is."""

from __future__ import annotations

from math import inf

from gr_ros2.link.pace import Pace
from gr_ros2.link.v1.slowness import Slowness
from gr_ros2.settings.fields import AUTO


def leave(pace: Pace, slowness: Slowness, free: float | None, now: float) -> None:
    """A message that has waited for long leaves."""
    pace.credit(1, free)
    assert pace.may_leave(now)
    slowness.waited(0.0, now)
    pace.left(now, waiting=True)


def test_what_waits_although_the_air_is_free_waits_for_the_computer() -> None:
    pace = Pace(AUTO)
    slowness = Slowness(pace)
    for tick in range(1, 20):
        leave(pace, slowness, free=0.1 * tick - 0.06, now=0.1 * tick)
    assert slowness.behind(2.0)
    for tick in range(20, 40):
        leave(pace, slowness, free=0.1 * tick - 0.01, now=0.1 * tick)
    assert not slowness.behind(4.0)


def test_a_credit_that_nobody_uses_is_a_computer_that_stands_still() -> None:
    pace = Pace(AUTO)
    pace.credit(1, 3.0)
    assert not Slowness(pace).behind(3.4)
    assert Slowness(pace).behind(3.6)


def test_credits_that_say_nothing_of_the_air_accuse_nobody() -> None:
    for free in (None, inf):
        pace = Pace(AUTO)
        slowness = Slowness(pace)
        for tick in range(1, 20):
            leave(pace, slowness, free, now=0.1 * tick)
        assert not slowness.behind(2.0)
