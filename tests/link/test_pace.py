"""The pace of a sending half: credits, a rate, both, or none."""

from __future__ import annotations

from math import inf

import pytest

from gr_ros2.link.pace import Pace
from gr_ros2.settings.fields import AUTO


def test_without_rate_and_credits_packets_leave_at_once() -> None:
    pace = Pace(AUTO)
    assert not pace.out_of_credit
    assert not pace.known
    pace.left(1.0, waiting=True)
    assert (pace.slot, pace.interval) == (-inf, 0.0)


def test_every_packet_takes_a_credit() -> None:
    pace = Pace(AUTO)
    pace.use_credit()
    assert pace.out_of_credit
    pace.credit(2)
    pace.left(0.0, waiting=True)
    assert not pace.out_of_credit
    pace.left(0.0, waiting=True)
    assert pace.out_of_credit
    assert pace.known


def test_the_interval_of_credits_is_measured_while_packets_wait() -> None:
    pace = Pace(AUTO)
    for at, waiting in ((0.0, True), (0.1, True), (0.2, False), (9.0, True)):
        pace.credit()
        assert pace.may_leave(at)
        pace.left(at, waiting=waiting)
    assert pace.interval == pytest.approx(0.1)


def test_the_first_interval_after_a_pause_counts_only_until_there_is_a_better_one() -> None:
    """The first credit after a pause comes early: the PHY asks before it is free."""
    pace = Pace(AUTO)
    pace.use_credit()
    assert not pace.may_leave(0.0)
    pace.credit()
    for at, interval in ((0.0, 0.0), (0.08, 0.08), (0.18, 0.1), (0.28, 0.1)):
        assert pace.may_leave(at)
        assert pace.interval == pytest.approx(interval)
        pace.left(at, waiting=True)
        pace.credit()
    assert pace.may_leave(1.0)
    assert pace.interval == pytest.approx(0.1)


def test_a_pause_of_sending_is_not_the_interval_of_the_phy() -> None:
    """Otherwise a message with a deadline is dropped as too slow for it, and so no packet shows that it is not."""
    pace = Pace(AUTO)
    pace.credit()
    assert pace.may_leave(0.0)
    pace.left(0.0, waiting=True)
    pace.credit(since=inf)
    assert pace.may_leave(60.0)
    assert pace.interval == 0.0
    pace.left(60.0, waiting=True)
    pace.credit()
    assert pace.may_leave(60.1)
    assert pace.interval == pytest.approx(0.1)


def test_messages_are_dropped_for_an_interval_only_if_it_was_measured_lately_and_more_than_once() -> None:
    pace = Pace(AUTO)
    pace.use_credit()
    assert pace.sure_interval(0.0) == 0.0
    pace.credit()
    for at, least in ((0.0, 0.0), (0.5, 0.0), (0.6, 0.0), (0.7, 0.1), (0.8, 0.1)):
        assert pace.may_leave(at)
        assert pace.sure_interval(at) == pytest.approx(least)
        pace.left(at, waiting=True)
        pace.credit()
    assert pace.sure_interval(60.0) == 0.0
    assert Pace(4.0).sure_interval(60.0) == 0.25


def test_long_packets_are_measured_for_as_many_packets_as_short_ones() -> None:
    pace = Pace(AUTO)
    pace.use_credit()
    pace.credit()
    for at in (0.0, 5.0, 10.0, 15.0, 20.0):
        assert pace.may_leave(at)
        pace.left(at, waiting=True)
        pace.credit()
    assert pace.sure_interval(21.0) == pytest.approx(5.0)


def test_the_air_is_free_when_all_that_left_is_over() -> None:
    pace = Pace(AUTO)
    pace.use_credit()
    assert pace.free(3.0) == 3.0
    for at in (0.0, 0.1, 0.2, 0.3):
        pace.credit()
        assert pace.may_leave(at)
        pace.left(at, waiting=True)
    assert pace.free(0.3) == pytest.approx(0.4)
    assert pace.free(0.5) == 0.5


def test_a_late_packet_does_not_lower_the_rate() -> None:
    pace = Pace(10.0)
    assert pace.interval == pytest.approx(0.1)
    pace.left(0.0, waiting=True)
    assert pace.slot == pytest.approx(0.0)
    pace.left(0.0, waiting=True)
    assert pace.slot == pytest.approx(0.1)
    pace.left(0.15, waiting=True)
    assert pace.slot == pytest.approx(0.2)
    pace.left(5.0, waiting=True)
    assert pace.slot == pytest.approx(5.0)


def test_a_rate_of_0_heeds_no_credits() -> None:
    pace = Pace(0)
    pace.use_credit()
    assert not pace.out_of_credit
    assert not pace.known
    pace.change(AUTO)
    assert pace.out_of_credit
