"""The limit of airtime: never more than allowed in any window, over restarts too."""

from __future__ import annotations

from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gr_ros2.core.errors import ConfigError
from gr_ros2.link.airtime import AirtimeClock
from gr_ros2.link.airtime_limit import PAUSE_S, AirtimeLimit, Spent, at_full_load
from gr_ros2.settings.airtime import AirtimeRule

HOUR = AirtimeRule(0.01, 3600.0)


class Disk:
    """Keeps an account as a file does, and takes none while it is full."""

    def __init__(self) -> None:
        self.at, self.spent, self.writes, self.full = 0.0, [], 0, False  # type: ignore[var-annotated]
        self.now = 0.0

    def save(self, spent: Spent) -> None:
        if self.full:
            raise ConfigError("full")
        self.at, self.spent, self.writes = self.now, list(spent), self.writes + 1

    def start(self, rule: AirtimeRule, longest: float) -> AirtimeLimit:
        spent = [(until - (self.now - self.at), airtime) for until, airtime in self.spent]
        return AirtimeLimit(rule, longest, now=self.now, spent=spent, save=self.save)


def most_in_a_window(sent: list[tuple[float, float]], window: float) -> float:
    """The largest airtime in any window. The maximum is in a window that ends with a packet."""
    largest = 0.0
    for begin, airtime in sent:
        end = begin + airtime
        inside = (max(0.0, min(end, b + a) - max(end - window, b)) for b, a in sent if b < end)
        largest = max(largest, sum(inside))
    return largest


@settings(max_examples=100, deadline=None)
@given(
    st.floats(0.001, 0.5),
    st.floats(1.0, 4000.0),
    st.sampled_from([0.0, 0.05, 1.0]),
    st.lists(
        st.tuples(
            st.sampled_from(["send", "send", "send", "send", "kill", "fill", "empty"]), st.floats(0, 1), st.floats(0, 1)
        ),
        min_size=5,
        max_size=80,
    ),
)
def test_no_window_has_more_than_its_share_whatever_happens(
    duty_cycle: float, window_s: float, max_burst_s: float, steps: list[tuple[str, float, float]]
) -> None:
    rule = AirtimeRule(duty_cycle, window_s, max_burst_s)
    longest = min(duty_cycle * window_s, max_burst_s or 1e9) / 4
    disk = Disk()
    limit = disk.start(rule, longest)
    sent: list[tuple[float, float]] = []
    for what, pause, size in steps:
        disk.now += pause * pause * window_s / 4
        if what == "kill":
            limit = disk.start(rule, longest)
        elif what in ("fill", "empty"):
            disk.full = what == "fill"
        else:
            airtime = longest * max(size, 0.01)
            for _ in range(5):
                begin = limit.earliest(disk.now, airtime)
                disk.now = begin
                if limit.reserve(begin, airtime):
                    limit.spend(begin, airtime)
                    sent.append((begin, airtime))
                    disk.now = begin + airtime
    assert most_in_a_window(sent, window_s) <= duty_cycle * window_s * (1 + 1e-6)
    if max_burst_s:
        since, over = 0.0, -1.0
        for begin, airtime in sent:
            since = begin if begin >= over + PAUSE_S - 1e-9 else since
            over = begin + airtime
            assert over - since <= max_burst_s + 1e-6


def hours(limit: AirtimeLimit, airtime: float, hours: int, disk: Disk | None = None) -> list[tuple[float, float]]:
    """What a robot sends that always has something to send."""
    sent, now = [], 0.0
    while now < hours * 3600:
        now = limit.earliest(now, airtime)
        if disk is not None:
            disk.now = now
        assert limit.reserve(now, airtime)
        limit.spend(now, airtime)
        sent.append((now, airtime))
        now += airtime
    return sent


def test_at_full_load_nine_tenths_are_used_and_no_silence_is_longer_than_half_a_minute() -> None:
    sent = hours(AirtimeLimit(HOUR, 0.06), 0.06, 4)
    later = [begin for begin, _ in sent if begin > 3600]
    assert len(later) * 0.06 / (3 * 36) > 0.85
    gaps = [after - before for before, after in pairwise(later)]
    assert max(gaps) < 10, "an hour's airtime is not spent at once"
    steady = at_full_load(HOUR, 0.06)
    assert steady.earliest(0.0, 0.06) < 10
    assert 0.85 < steady.spent(0.0) / steady.budget < 1.01


def test_there_is_a_write_now_and_then_and_not_one_per_packet() -> None:
    disk = Disk()
    sent = hours(disk.start(HOUR, 0.06), 0.06, 2, disk)
    assert len(sent) > 1000
    assert disk.writes < 150


def test_a_full_disk_stops_sending_when_the_reservation_is_used_up_and_no_earlier() -> None:
    disk = Disk()
    limit = disk.start(HOUR, 0.06)
    assert limit.reserve(0.0, 0.06)
    disk.full = True
    passed = 0
    while limit.reserve(1.0, 0.06):
        limit.spend(1.0, 0.06)
        passed += 1
    assert 2 <= passed <= 12
    assert (limit.unsaved, limit.stored) == (1, False)
    assert limit.again(1.0) is not None
    disk.full = False
    assert not limit.reserve(1.5, 0.06), "the disk is not asked with every packet"
    assert limit.reserve(2.1, 0.06)
    assert limit.stored


def test_a_burst_ends_with_a_pause() -> None:
    limit = AirtimeLimit(AirtimeRule(max_burst_s=0.4), 0.15, now=-1.0)
    limit.spend(limit.earliest(0.0, 0.15), 0.15)
    limit.spend(limit.earliest(0.15, 0.15), 0.15)
    assert limit.earliest(0.3, 0.15) == pytest.approx(0.3 + PAUSE_S)
    assert limit.earliest(0.3, 0.1) == 0.3, "a shorter packet fits"


def test_a_packet_that_can_never_leave_is_refused_with_the_remedy() -> None:
    with pytest.raises(ConfigError, match=r"0\.5 s, and 0\.4 s are allowed in 20 s; set a smaller packet_len"):
        AirtimeLimit(AirtimeRule(0.02, 20.0), 0.5)
    with pytest.raises(ConfigError, match="in one burst"):
        AirtimeLimit(AirtimeRule(max_burst_s=0.4), 0.5)


def test_credits_come_as_the_limit_lets_packets_leave() -> None:
    clock: AirtimeClock[str] = AirtimeClock(0.1, limit=AirtimeLimit(AirtimeRule(0.1, 10.0), 0.1))
    now = sent = 0.0
    while now < 100.0:
        clock.due(now)
        for _ in range(clock.grants(now)):
            assert clock.offer("x", now) is not None
            sent += 0.1
        at = clock.next_timeout(now)
        assert at is not None
        assert at > now
        now = at
    assert 8.0 < sent <= 11.0
    assert not clock.refused
    assert clock.used == pytest.approx(sent)


def test_a_packet_without_a_credit_is_refused_where_it_would_have_to_wait() -> None:
    clock: AirtimeClock[str] = AirtimeClock(0.5, limit=AirtimeLimit(AirtimeRule(0.1, 10.0), 0.5))
    taken = [clock.offer("x", 0.0) for _ in range(4)]
    assert taken[0] is not None
    assert taken[-1] is None
    assert clock.refused["airtime_limit"] == taken.count(None) > 0


def test_with_sending_switched_off_nothing_passes_and_no_credit_comes() -> None:
    clock: AirtimeClock[str] = AirtimeClock(0.5)
    clock.offer("waits", 0.0)
    clock.switch(on=False)
    assert clock.offer("late", 0.1) is None
    assert clock.due(10.0) == []
    assert (clock.grants(10.0), clock.next_timeout(10.0)) == (0, None)
    assert clock.refused == {"transmit_off": 2}
    clock.switch(on=True)
    assert clock.grants(10.0) == 1
