"""Repairs that wait for a new message: what is expected when, and that no wait is without end."""

from __future__ import annotations

from math import inf

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gr_ros2.core.tuning import Tuning
from gr_ros2.link.events import SenderEvent, SentPacket
from gr_ros2.link.v1.endpoint import EndpointV1
from gr_ros2.link.v1.endpoint_settings import Settings
from gr_ros2.link.v1.hold import Hold, Period
from gr_ros2.settings.config import SendOptions
from gr_ros2.settings.registry import Registry, Topic

TUNING = Tuning()

AIRTIME = 0.013
PERIOD = 1 / 35


def hold(*, period: float = PERIOD, count: int = 10) -> Hold:
    """One that has seen a topic; its last message came at 0, and has left."""
    made = Hold(TUNING)
    for number in range(1 - count, 1):
        made.submitted(0, number * period)
    made.left(0.0, 0.0)
    return made


def test_a_repair_that_is_over_in_time_does_not_wait() -> None:
    assert hold().until(0.013, 0.026, AIRTIME) == 0.013


def test_a_repair_that_would_delay_the_next_message_waits_for_it() -> None:
    waiting = hold()
    until = waiting.until(0.026, 0.039, AIRTIME)
    assert until > PERIOD
    assert until == waiting.until(0.028, 0.041, AIRTIME), "it still waits for the same message"
    waiting.submitted(0, PERIOD)
    waiting.left(PERIOD, 0.0)
    assert waiting.until(PERIOD + 0.013, PERIOD + 0.026, AIRTIME) == PERIOD + 0.013


def test_a_message_that_does_not_come_is_not_waited_for_twice() -> None:
    waiting = hold()
    until = waiting.until(0.026, 0.039, AIRTIME)
    assert waiting.until(until, until + AIRTIME, AIRTIME) == until
    assert waiting.until(until + PERIOD, until + PERIOD + AIRTIME, AIRTIME) == until + PERIOD


def test_a_topic_of_which_one_message_has_come_is_not_waited_for() -> None:
    made = Hold(TUNING)
    made.submitted(0, 0.1)
    for now in (0.11, 0.15, 0.195, 0.25, 0.35):
        assert made.until(now, now + AIRTIME, AIRTIME) == now


def test_what_is_no_repair_waits_however_many_repairs_are_owed() -> None:
    owing = hold()
    for _ in range(10):
        owing.left(0.0, 0.2)
    assert owing.until(0.026, 0.039, AIRTIME) == 0.026
    assert owing.until(0.026, 0.039, AIRTIME, repairs=False) > PERIOD


def test_without_a_known_airtime_nothing_waits() -> None:
    assert hold().until(0.026, 0.026, 0.0) == 0.026


@pytest.mark.parametrize("jitter", [0.0, 0.002])
def test_a_period_is_learned_and_followed(jitter: float) -> None:
    period = Period(0.0, TUNING.hold_smoothing)
    for number in range(1, 40):
        period.observe(number * 0.1 + jitter * (-1) ** number)
    assert period.due == pytest.approx(4.0, abs=0.004)
    for number in range(1, 40):
        period.observe(3.9 + number * 0.15)
    assert period.due == pytest.approx(3.9 + 40 * 0.15, abs=0.002)


def test_messages_that_are_missing_do_not_end_a_period() -> None:
    period = Period(0.0, TUNING.hold_smoothing)
    for number in (*range(1, 20), *range(21, 40)):
        period.observe(number * 0.1)
    assert period.due == pytest.approx(4.0, abs=0.005)


def test_where_slots_are_fixed_waiting_is_soon_left_off() -> None:
    made = hold()
    held = 0
    for number in range(1, 1001):
        slot = number * PERIOD - 0.005  # the message comes in the middle of it, and leaves at its end
        if made.until(slot, slot + AIRTIME, AIRTIME) > slot:
            held += 1
        else:
            made.repaired(waiting=False)
        made.submitted(0, number * PERIOD)
        made.left(slot + AIRTIME, 0.2)
    assert 1 <= held <= 10


def test_messages_that_come_and_never_leave_are_not_waited_for_without_end() -> None:
    """Four topics, of which one is always due soon, and all their messages are refused."""
    made = Hold(TUNING)
    held: list[float] = []
    longest = 0.0
    for number in range(1, 2000):
        now = number * 0.001
        if number % 5 == 0:
            made.submitted(number // 5 % 4, now)
        if made.until(now, now + AIRTIME, AIRTIME) > now:
            held.append(now)
            longest = max(longest, now - held[0])
        else:
            made.repaired(waiting=False)
            held.clear()
    assert AIRTIME < longest <= 2 * AIRTIME


@pytest.mark.parametrize("loss", [0.0, 0.05, 0.2])
def test_where_no_repair_fits_between_two_messages_they_leave_as_losses_call_for_them(loss: float) -> None:
    period = 1 / 55
    made = hold(period=period)
    repairs = 0
    for number in range(1, 321):
        at = number * period
        made.submitted(0, at)
        made.left(at, loss)
        if made.until(at + AIRTIME, at + 2 * AIRTIME, AIRTIME) == at + AIRTIME:
            made.repaired(waiting=False)
            repairs += 1
    assert repairs == pytest.approx(320 * TUNING.hold_surplus * loss / (1 - loss), abs=2)


_STEPS = st.lists(
    st.tuples(st.integers(0, 4), st.floats(1e-4, 0.05), st.sampled_from(["submit", "leave", "ask"])), max_size=300
)


@given(_STEPS)
def test_no_wait_is_without_end(steps: list[tuple[int, float, str]]) -> None:
    """A wait lasts two airtimes at most, whatever comes, leaves, or never leaves."""
    made = Hold(TUNING)
    now, since = 0.0, None
    for topic_id, after, what in steps:
        now += after
        if what == "submit":
            made.submitted(topic_id, now)
        elif what == "leave":
            made.left(now, 0.0)
            since = None
        else:
            until = made.until(now, now + AIRTIME, AIRTIME)
            if until == now:
                made.repaired(waiting=False)
                since = None
            else:
                assert until > now
                since = now if since is None else since
                assert until <= since + 2 * AIRTIME + 1e-9


class Sending:
    """An endpoint that sends over a PHY which is asked for a packet shortly before the air is free."""

    def __init__(self, periods: list[float]) -> None:
        self.events: list[SenderEvent] = []
        names = [Topic(n, f"t{n}", "std_msgs/msg/String", SendOptions()) for n in range(len(periods))]
        one_way = Settings(1, packet_len=64, hears=False)
        self.end = EndpointV1(Registry(names), one_way, boot=5, observer=self.events.append)
        self.end.pace.use_credit()
        self.end.pace.credit()
        self.free = 0.0
        self.credit_at = inf

    def ask(self, now: float) -> str | None:
        """What leaves now."""
        if now >= self.credit_at:
            self.credit_at = inf
            self.end.pace.credit()
        if self.end.next_packet(now) is None:
            return None
        self.free = max(now, self.free) + AIRTIME
        self.credit_at = self.free - 0.005
        sent = [event for event in self.events if isinstance(event, SentPacket)]
        return sent[-1].kind

    def due(self, now: float) -> float:
        """When to ask again."""
        at = self.end.next_departure()
        return min(self.credit_at, inf if at is None else max(at, now))


@settings(max_examples=40)
@given(
    st.lists(st.floats(0.014, 0.4), min_size=1, max_size=4),
    st.lists(st.floats(0, 0.01), min_size=8, max_size=8),
    st.integers(1, 45),
)
def test_a_hold_delays_no_message_and_starves_no_repair(periods: list[float], jitter: list[float], size: int) -> None:
    sending = Sending(periods)
    count = [1] * len(periods)
    coming = list(periods)
    now, left, asked = 0.0, [], 0
    while now < 3.0 or asked < 2:
        quiet = now >= 3.0
        topic_id = coming.index(min(coming))
        upcoming = inf if quiet else coming[topic_id]
        at = min(upcoming, sending.due(now))
        assert at > now or asked < 3, "it is asked again and again at one time"
        asked = 0 if at > now else asked + 1
        now = max(now, at)
        if quiet and left and now > left[-1][0] + 4 * AIRTIME:
            break
        if now >= upcoming:
            sending.end.messages.submit(topic_id, bytes(size), now)
            count[topic_id] += 1
            coming[topic_id] = count[topic_id] * periods[topic_id] + jitter[count[topic_id] % 8]
        waiting = not sending.end.messages.idle
        free = not sending.end.pace.out_of_credit or now >= sending.credit_at
        kind = sending.ask(now)
        if kind is not None:
            left.append((now, kind))
        if waiting and free:
            assert kind in ("new", "hello")
        if quiet and len(left) > 4 and [kind for _, kind in left[-4:]] == ["repair"] * 4:
            break
    assert "repair" in [kind for _, kind in left[-8:]], "when nothing more comes, repair has the air"
