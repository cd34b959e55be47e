"""The air: one packet after the other, never early, never promised far ahead."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gr_ros2.core.errors import ConfigError
from gr_ros2.link.airtime import LEAD_S, LEAST_LEAD_S, MEASURED, AirtimeClock
from gr_ros2.link.airtime_limit import AirtimeLimit
from gr_ros2.settings.airtime import AirtimeRule


def packets(due: list[tuple[float, str]]) -> list[str]:
    return [packet for _, packet in due]


def test_a_packet_leaves_when_its_airtime_is_over_and_not_before() -> None:
    clock: AirtimeClock[str] = AirtimeClock(1.0)
    clock.offer("a", 10.0)
    assert clock.due(10.999) == []
    assert packets(clock.due(11.0)) == ["a"]


def test_packets_queue_for_the_air_and_idle_time_is_not_saved_up() -> None:
    clock: AirtimeClock[str] = AirtimeClock(1.0)
    clock.offer("a", 0.0)
    clock.offer("b", 0.1)
    assert clock.backlog == 2
    assert packets(clock.due(1.0)) == ["a"]
    assert packets(clock.due(2.0)) == ["b"]
    clock.offer("c", 50.0)
    clock.offer("d", 50.0)
    assert packets(clock.due(51.5)) == ["c"]
    assert packets(clock.due(52.0)) == ["d"]
    assert clock.backlog == 0


def test_a_device_gets_packets_when_their_airtime_begins_or_a_little_before() -> None:
    clock: AirtimeClock[str] = AirtimeClock(1.0, ahead=0.25)
    clock.offer("a", 10.0)
    assert packets(clock.due(10.0)) == ["a"]
    clock.offer("b", 10.5)
    assert clock.due(10.7) == []
    assert clock.next_timeout(10.7) == 10.75
    assert packets(clock.due(10.75)) == ["b"]
    assert clock.grants(11.0) == 0, "the air is b's until 12"
    assert clock.grants(12.0) == 1
    with pytest.raises(ConfigError, match="ahead"):
        AirtimeClock(1.0, ahead=-0.1)


def test_one_credit_at_the_start_and_the_next_just_before_the_air_is_free() -> None:
    clock: AirtimeClock[str] = AirtimeClock(0.1, lead=0.005)
    assert clock.grants(0.0) == 1
    assert clock.grants(5.0) == 0, "an unused credit stays open"
    clock.offer("a", 5.0)
    assert clock.grants(5.0) == 0
    assert clock.next_timeout(5.0) == pytest.approx(5.095)
    assert clock.grants(5.09) == 0
    assert clock.grants(5.0951) == 1
    assert clock.grants(5.2) == 0


def test_a_device_that_takes_packets_long_ahead_gets_them_one_after_the_other() -> None:
    clock = AirtimeClock[str](0.1, lead=0.005, ahead=0.4)
    now, begins = 0.0, [0.4]
    clock.grants(now)
    clock.offer("first", now, leave_at=0.4)
    while len(begins) < 10:
        at = clock.next_timeout(now)
        assert at is not None
        now = max(now, at)
        clock.due(now)
        if clock.grants(now):
            begin = clock.offer("next", now + 0.004, leave_at=begins[-1] + 0.1)
            assert begin is not None and begin >= now + 0.004 + 0.4, "it comes in time"
            begins.append(begin)
    assert begins == pytest.approx([0.4 + 0.1 * number for number in range(10)])


def test_at_most_two_packets_are_here_or_promised_however_short_they_are() -> None:
    clock: AirtimeClock[str] = AirtimeClock(0.001, lead=0.005)
    assert clock.grants(0.0) == 2
    clock.offer("a", 0.0)
    assert clock.grants(0.0) == 0
    assert clock.next_timeout(0.0) == pytest.approx(0.001), "the next credit comes when the first is through"
    assert packets(clock.due(0.001)) == ["a"]
    assert clock.grants(0.001) == 1


def steady(clock: AirtimeClock[str], packets: int, composing: float, now: float = 0.0) -> tuple[float, float]:
    """A source that always has something to send and takes so long for each packet: how long before the air is free
    the last credit was given, and how long the air was free in between, s."""
    lead = gaps = free = 0.0
    for _ in range(packets):
        while not clock.grants(now):
            at = clock.next_timeout(now)
            assert at is not None
            now = max(at, now + 1e-9)
            clock.due(now)
        lead, now = free - now, now + composing
        gaps += max(0.0, now - free) if free else 0.0
        free = (clock.offer("packet", now) or 0.0) + 0.02
    return lead, gaps


@pytest.mark.parametrize("composing", [0.0, 0.0004, 0.003, 0.005])
def test_a_measured_lead_is_what_the_source_needs_and_the_air_never_waits_for_it(composing: float) -> None:
    clock: AirtimeClock[str] = AirtimeClock(0.02, measured=True)
    assert steady(clock, 3, composing)[0] == pytest.approx(LEAD_S, abs=1e-6)
    lead, gaps = steady(clock, 2 * MEASURED, composing, now=1.0)
    assert lead == pytest.approx(max(composing, LEAST_LEAD_S), abs=1e-6)
    assert gaps == pytest.approx(0.0, abs=1e-6 * MEASURED)


def test_a_pause_of_the_computer_or_of_the_topics_does_not_change_a_measured_lead() -> None:
    clock: AirtimeClock[str] = AirtimeClock(0.02, measured=True)
    steady(clock, 2 * MEASURED, 0.001)
    steady(clock, 2, 0.5, now=10.0)
    assert steady(clock, 2, 0.001, now=20.0)[0] == pytest.approx(0.001, abs=1e-6)


def test_one_packet_that_took_longer_lengthens_a_measured_lead_for_a_while() -> None:
    clock: AirtimeClock[str] = AirtimeClock(0.02, measured=True)
    steady(clock, 2 * MEASURED, 0.001)
    steady(clock, 1, 0.004, now=10.0)
    assert steady(clock, MEASURED, 0.001, now=20.0)[0] == pytest.approx(0.004, abs=1e-6)
    assert steady(clock, 2, 0.001, now=30.0)[0] == pytest.approx(0.001, abs=1e-6)


def test_when_the_first_packet_is_due() -> None:
    clock: AirtimeClock[str] = AirtimeClock(0.5)
    assert clock.first_due is None
    clock.offer("a", 10.0)
    clock.offer("b", 10.1)
    assert clock.first_due == 10.5
    assert packets(clock.due(10.7)) == ["a"]
    assert clock.first_due == 11.0


def test_nothing_to_wait_for_on_idle_air() -> None:
    clock: AirtimeClock[str] = AirtimeClock(0.1)
    clock.grants(0.0)
    assert clock.next_timeout(0.0) is None


@pytest.mark.parametrize(("airtime", "lead"), [(-1.0, 0.005), (float("nan"), 0.0), (1.0, -0.1)])
def test_senseless_times_are_refused(airtime: float, lead: float) -> None:
    with pytest.raises(ConfigError):
        AirtimeClock(airtime, lead)


@settings(max_examples=40, deadline=None)
@given(
    airtime=st.floats(0.0005, 0.5),
    lead=st.floats(0, 0.02),
    thinking=st.lists(st.floats(0, 0.3), min_size=1, max_size=40),
)
def test_a_source_that_obeys_credits_never_overlaps_and_never_piles_up(
    airtime: float, lead: float, thinking: list[float]
) -> None:
    """Drive the clock as the gate does, a source taking some time over each packet once it has a credit."""
    clock: AirtimeClock[float] = AirtimeClock(airtime, lead)
    now, credits, ends = 0.0, 0, []
    for pause in thinking:
        deadline = now + airtime * 3 + lead + 1
        while not credits:
            ends += [now] * len(clock.due(now))
            credits += clock.grants(now)
            if not credits:
                at = clock.next_timeout(now)
                assert at is not None and at <= deadline
                now = max(at, now + 1e-9)
        now += pause
        ends += [now] * len(clock.due(now))
        clock.offer(now, now)
        credits -= 1
        assert clock.backlog <= 2
    while clock.backlog:
        clock.grants(now)
        at = clock.next_timeout(now)
        assert at is not None
        now = max(at, now + 1e-9)
        ends += [now] * len(clock.due(now))
    assert len(ends) == len(thinking)


def test_a_packet_takes_the_air_for_its_own_airtime_and_is_promised_that_of_the_longest() -> None:
    clock: AirtimeClock[str] = AirtimeClock(1.0, lead=0.0)
    clock.offer("short", 0.0, 0.25)
    clock.offer("long", 0.0)
    assert clock.due(0.24) == []
    assert packets(clock.due(0.25)) == ["short"]
    assert clock.due(1.24) == []
    assert packets(clock.due(1.25)) == ["long"]
    assert clock.grants(1.25) == 1
    assert clock.grants(2.24) == 0
    clock.offer("short", 1.25, 0.25)
    assert clock.grants(1.5) == 1


def test_a_packet_that_asks_for_a_time_begins_then_and_later_ones_behind_it() -> None:
    clock: AirtimeClock[str] = AirtimeClock(1.0, ahead=0.0)
    assert clock.offer("slot", 10.0, leave_at=12.0) == 12.0
    assert clock.offer("next", 10.0) == 13.0
    assert clock.offer("missed", 15.0, leave_at=14.5) == 15.0
    assert clock.due(11.999) == []
    assert clock.due(15.0) == [(12.0, "slot"), (13.0, "next"), (15.0, "missed")]


def test_a_packet_waits_while_somebody_else_sends() -> None:
    heard = [0.3, 0.2, 0.0, 0.0]
    clock: AirtimeClock[str] = AirtimeClock(1.0, ahead=0.0, listens=lambda: heard.pop(0))
    assert clock.grants(0.0) == 1, "one at a time: what waits behind a packet could not be listened for"
    clock.offer("a", 0.0)
    assert clock.grants(0.0) == 0
    assert clock.due(0.0) == []
    assert clock.next_timeout(0.0) == pytest.approx(0.3)
    assert clock.due(0.31) == []
    assert clock.next_timeout(0.31) == pytest.approx(0.51)
    assert packets(clock.due(0.51)) == ["a"]
    assert clock.deferred == 2
    assert clock.grants(1.4) == 0, "its airtime began at 0.51"
    assert clock.grants(1.51) == 1
    clock.offer("b", 1.6)
    assert packets(clock.due(1.6)) == ["b"]


def test_a_limit_counts_a_packet_that_waited_when_it_leaves() -> None:
    heard = [1.0] * 5 + [0.0]
    rule = AirtimeRule(duty_cycle=0.1, window_s=20.0)
    limit = AirtimeLimit(rule, 1.0)
    clock: AirtimeClock[str] = AirtimeClock(1.0, ahead=0.0, limit=limit, listens=lambda: heard.pop(0))
    clock.offer("a", 0.0)
    now = 0.0
    while not clock.due(now):
        now += 1.0
    assert now == 5.0
    assert limit.spent(now + 1.0 + rule.window_s - 0.1) == 1.0
    assert limit.spent(now + 1.0 + 2 * rule.window_s) == 0.0


def test_credits_that_the_switch_or_the_limit_held_back_are_known() -> None:
    clock: AirtimeClock[str] = AirtimeClock(1.0, lead=0.0)
    assert clock.grants(0.0) == 1
    assert not clock.held
    clock.switch(on=False)
    assert clock.grants(5.0) == 0
    clock.switch(on=True)
    clock.offer("first", 9.0)
    clock.due(10.0)
    assert clock.grants(10.0) == 1
    assert clock.held
    clock.offer("second", 10.0)
    clock.due(11.0)
    assert clock.grants(11.0) == 1
    assert not clock.held

    both: AirtimeClock[str] = AirtimeClock(0.0)
    both.switch(on=False)
    both.switch(on=True)
    assert both.grants(1.0) == 2
    assert both.held

    limited: AirtimeClock[str] = AirtimeClock(1.0, lead=0.0, limit=AirtimeLimit(AirtimeRule(0.01, window_s=200.0), 1.0))
    held = []
    now = 0.0
    while len(held) < 5:
        if limited.grants(now):
            held.append(limited.held)
            limited.offer("a packet", now)
        again = limited.next_timeout(now)
        assert again is not None
        limited.due(again)
        now = max(again, now + 1e-6)
    assert held == [False, True, True, True, True]


def test_packets_wait_for_a_device_that_is_away_and_none_is_asked_for_meanwhile() -> None:
    there = True
    clock: AirtimeClock[str] = AirtimeClock(1.0, ready=lambda: there)
    assert clock.grants(0.0) == 1
    clock.offer("a", 0.0)
    there = False
    for now in range(1, 20):
        assert clock.due(now) == []
        assert clock.grants(now) == 0
        assert now < (clock.next_timeout(now) or 0.0) < now + 0.1
    there = True
    assert packets(clock.due(20.0)) == ["a"]
    assert clock.grants(20.0) == 1
    assert clock.held, "that this came late says nothing of the pace"
    assert clock.deferred == 0
