"""Packets that overtake each other on several radios: nothing of what came is left out, and nothing waits for long."""

from __future__ import annotations

import random
from statistics import mean

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gr_ros2.core.tuning import Tuning
from gr_ros2.link.events import Delivered
from gr_ros2.link.v1.decoder import RepairDecoder
from gr_ros2.link.v1.gap_contents import GapContents
from gr_ros2.link.v1.order import Ready
from gr_ros2.link.v1.overtaking import Overtaken, Overtaking
from gr_ros2.link.v1.sealing import SealMode
from gr_ros2.settings.config import SendOptions
from tests.link.v1.air import registry
from tests.link.v1.radios import LOOK_S, Radios, Station

TUNING = Tuning()

RATE = 12_500.0
"""Bytes/s of a radio: a packet takes up to 18 ms."""
BULK, ODOM, CMD = range(3)
TOPICS = registry(
    bulk=SendOptions(qos="bulk", reliability="best_effort"),
    odom=SendOptions(reliability="best_effort"),
    cmd_vel=SendOptions(qos="latency", queue="deadline", deadline_s=0.3, reliability="best_effort"),
)


class FilledRadios:
    """Two stations; the first one always has something to send beside odometry.

    :param rates: bytes/s of each radio
    """

    def __init__(
        self, *rates: float, mode: SealMode = "none", jitter_s: float = 0.001, loss: float = 0.0, told: int = 0
    ) -> None:
        known = {"radios": told} if told else {}
        self.sender = Station(1, TOPICS, rates, mode=mode, **known)
        self.receiver = Station(2, None, rates, mode=mode, **known)
        self.air = Radios(self.sender, self.receiver, jitter_s=jitter_s)
        self.made: dict[bytes, float] = {}
        rng = self.rng = random.Random(2)
        self.air.lost = lambda _station, _radio: rng.random() < loss

    def fill(self) -> None:
        """Always have something to send."""
        self.air.every(0.01, lambda _: self._fill())
        self.air.every(0.05, lambda _: self.submit(ODOM, 40))

    def submit(self, topic_id: int, size: int) -> None:
        """A message of a robot's program."""
        payload = self.rng.randbytes(size)
        self.made[payload] = self.air.now
        self.sender.end.messages.submit(topic_id, payload, self.air.now)

    def _fill(self) -> None:
        for _ in range(16 - self.sender.end.messages.queued().get(BULK, 0)):
            self.submit(BULK, 150)

    def age_s(self, topic_id: int) -> float:
        """Mean age of what came."""
        events = [(at, event) for at, event in self.receiver.came if event.topic_id == topic_id]
        return mean(at - self.made[event.payload] for at, event in events if isinstance(event, Delivered))


@pytest.mark.parametrize(
    ("mode", "jitter_s", "loss"), [("none", 0.001, 0.0), ("encrypt", 0.003, 0.0), ("none", 0.001, 0.2)]
)
def test_two_like_radios_carry_twice_as_much_as_one_without_acknowledgements(
    mode: SealMode, jitter_s: float, loss: float
) -> None:
    carried, ages = [], []
    for rates in ((RATE,), (RATE, RATE)):
        filled = FilledRadios(*rates, mode=mode, jitter_s=jitter_s, loss=loss)
        filled.fill()
        filled.air.run(5.0)
        carried.append(len(filled.receiver.payloads(BULK, since=1.0)))
        ages.append(filled.age_s(ODOM))
    assert carried[1] >= 1.95 * carried[0]
    assert ages[1] <= ages[0] * 1.05


def test_what_is_overtaken_does_not_count_as_lost() -> None:
    filled = FilledRadios(RATE, RATE)
    filled.fill()
    filled.air.run(4.0)
    assert filled.receiver.end.received.missed[1] < 0.01 * filled.receiver.end.received.packets
    assert filled.receiver.end.neighbours.all[1].inbox.reports.loss < 0.02


@pytest.mark.parametrize("loss", [0.0, 0.3])
def test_nothing_waits_where_only_one_radio_carries(loss: float) -> None:
    came = []
    for told in (1, 2):
        filled = FilledRadios(RATE, RATE / 100, loss=loss, told=told)
        filled.fill()
        filled.air.run(3.0)
        came.append(filled.receiver.came)
    assert len(came[0]) > 100
    assert came[0] == came[1]


def test_commands_do_not_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    held: set[int] = set()
    holds = Overtaking.holds

    def note(self: Overtaking, ready: Ready, now: float) -> bool:
        held.update({ready.topic_id} if (waits := holds(self, ready, now)) else ())
        return waits

    monkeypatch.setattr(Overtaking, "holds", note)
    filled = FilledRadios(RATE, RATE)
    filled.fill()
    filled.air.every(0.05, lambda _: filled.submit(CMD, 12))
    filled.air.run(4.0)
    assert BULK in held
    assert CMD not in held
    assert len(filled.receiver.payloads(CMD)) >= 78


def test_what_waits_when_its_sender_starts_anew_comes_out() -> None:
    filled = FilledRadios(RATE, RATE)
    filled.fill()
    filled.air.run(2.0)
    overtaking = filled.receiver.end.neighbours.all[1].inbox._overtaking
    assert overtaking is not None
    while not (waiting := list(overtaking._waiting)):
        filled.air.run(LOOK_S)
    filled.sender.start()
    filled.sender.switch_on()
    filled.air.run(0.5)
    came = filled.receiver.payloads(BULK)
    assert all(ready.payload in came for ready in waiting)
    started = filled.receiver.end.neighbours.all[1].inbox._overtaking
    assert started is not overtaking
    assert started is not None
    assert started._learned.wait_s > 0, "what was learned of the start before"


@given(
    st.lists(
        st.tuples(st.floats(0, 0.03), st.sampled_from((0.0, 0.0, 0.0, 1.0, 5.0, 30.0)), st.booleans()), max_size=80
    )
)
@settings(max_examples=60, deadline=None)
def test_messages_come_out_once_in_order_and_soon(packets: list[tuple[float, float, bool]]) -> None:
    """Each packet, with one message, leaves some s after the one before, comes so many ms late, or does not come."""
    decoder = RepairDecoder(100, lambda _: True, 1000)
    overtaking = Overtaking(decoder, GapContents(decoder, 100, TUNING), Overtaken(TUNING))
    left, arrivals = 0.0, []
    for number, (pause_s, late_ms, lost) in enumerate(packets):
        left += pause_s
        if not lost:
            arrivals.append((left + late_ms / 1e3, number))
    out: list[tuple[float, int]] = []
    lost_packets = 0

    def settle(now: float) -> None:
        nonlocal lost_packets
        lost_packets += overtaking.lost(now)
        out.extend((now, ready.order[0]) for ready in overtaking.due(now))

    came: dict[int, float] = {}
    for at, number in sorted(arrivals):
        while (due := overtaking.next_timeout()) is not None and due <= at:
            settle(due)
        newest = decoder.newest
        if number > newest + 1:
            overtaking.missing(at, newest + 1, number - 1)
        overtaking.came(number, at, late=number < newest)
        decoder.source(number, bytes(100))
        came[number] = at
        if not overtaking.holds(Ready(0, (number, 0), b"", 0, False, False), at):
            out.append((at, number))
        settle(at)
    while (due := overtaking.next_timeout()) is not None:
        settle(due)
    assert sorted(number for _, number in out) == sorted(came)
    assert all(at - came[number] <= TUNING.overtaken_most_s + 1e-9 for at, number in out)
    out_at = {number: at for at, number in out}
    newest = -1
    for _, number in out:  # whoever delivers leaves out one that comes so late that nobody waited for it
        assert number > newest or came[number] >= out_at[newest]
        newest = max(newest, number)
    assert lost_packets <= len(packets)
