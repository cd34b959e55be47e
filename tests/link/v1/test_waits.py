"""A message that waited at its origin: who hears it, and who gets it over others, counts from its submission."""

from __future__ import annotations

import random
from collections.abc import Iterator
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gr_ros2.core.tuning import Tuning
from gr_ros2.link.events import Delivered, ReceiverEvent, SentPacket
from gr_ros2.link.v1.delivery import MAX_AGE_S
from gr_ros2.link.v1.message import Message
from gr_ros2.link.v1.sealing import SealMode
from gr_ros2.settings.config import SendOptions
from gr_ros2.settings.registry import CALLS_TYPE, Registry, Topic
from gr_ros2.wire import control
from gr_ros2.wire.ages import AGE_STEP_S, age_of
from gr_ros2.wire.control import Control, Waited
from gr_ros2.wire.v1 import PacketV1
from tests.link.v1.air import SLOT_S, Air, Robot, registry
from tests.link.v1.test_ages import MODES, absent
from tests.link.v1.test_relaying import Line, robot

TUNING = Tuning()

WITHIN_S = 4.0
SCAN = SendOptions(queue="deadline", deadline_s=WITHIN_S)
LONG = SendOptions(queue="deadline", deadline_s=8.0)


def rows(option: SendOptions, **others: SendOptions) -> Registry:
    return registry(odom=SendOptions(queue="latest"), scan=option, **others)


def told(one: Robot) -> list[Waited]:
    """What a robot has told of how long its messages had waited."""
    bodies = [
        event.packet.body
        for event in one.events
        if isinstance(event, SentPacket) and isinstance(event.packet, PacketV1)
    ]
    return [entry for body in bodies for entry in body if isinstance(entry, Waited)]


def hold_back(one: Robot, seconds: float, run: Any) -> None:
    """It sends nothing for so long."""
    one.slot = lambda _: None  # type: ignore[assignment,method-assign]
    run(seconds)
    del one.slot


def came(one: Robot, payload: bytes) -> Iterator[Delivered]:
    return (event for event in one.events if isinstance(event, Delivered) and event.payload == payload)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("option", [SCAN, LONG])
@pytest.mark.parametrize(("waits", "held", "comes"), [(0.0, 0.5, True), (0.4, 0.1, True), (0.4, 0.8, False)])
def test_what_a_relay_holds_counts_from_its_submission(
    mode: SealMode, option: SendOptions, waits: float, held: float, comes: bool
) -> None:
    """It waits at robot 1, then at robot 2 until robot 3 is there, for parts of its deadline. Of ``LONG`` all are
    relayed, in order. With a key, the time since the last proof counts beside its age, so a longer hold may be refused.
    """
    line = Line(robot(1, mode, rows(option)), *(robot(src_id, mode) for src_id in (2, 3)))
    line.run(12)
    absent(line, 3)
    line.run(1)
    limit_s, first = float(option.deadline_s), line.robots[0]
    first.end.messages.submit(1, b"scan", line.now)
    hold_back(first, waits * limit_s, line.run)
    while b"scan" not in line.robots[1].delivered(1):
        line.run(0.1)
    absent(line, 1, 3)
    line.now += held * limit_s
    line._messages = int(line.now / 0.3)
    absent(line, 1)
    line.run(5)
    assert (b"scan" in line.robots[2].delivered(1)) == comes


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("comes", [True, False])
def test_what_waits_for_an_earlier_one_counts_from_its_submission(mode: SealMode, comes: bool) -> None:
    """The packet before it is lost and repaired late."""
    sender, receiver = Robot(1, rows(SCAN), mode=mode), Robot(2, mode=mode)
    air = Air(sender, receiver)
    air.run(3)
    lost = packet_with(sender, b"first", air.now)
    sender.end.messages.submit(1, b"second", air.now)
    air.now += 3.0
    receiver.receive(packet_with(sender, b"", air.now), air.now)
    assert not receiver.delivered()
    air.now += 0.5 if comes else 1.5
    receiver.receive(lost, air.now)
    assert (b"second" in receiver.delivered()) == comes


def packet_with(one: Robot, payload: bytes, now: float) -> bytes:
    """The next source packet, with a message if there is one."""
    if payload:
        one.end.messages.submit(1, payload, now)
    number = one.end.window.packets.newest
    while True:
        data = one.slot(now)
        assert data is not None
        if one.end.window.packets.newest > number:
            return data


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("any_length", [True, False])
@pytest.mark.parametrize("relay", [True, False])
def test_messages_of_every_length_leave_with_their_age(mode: SealMode, any_length: bool, relay: bool) -> None:
    """Also those that fill a packet but for the age, several in one packet, and fragments."""
    sender = Robot(1, rows(SCAN, text=SendOptions()), mode=mode, relay=relay, any_length=any_length)
    receiver = Robot(2, mode=mode, relay=relay, any_length=any_length)
    air = Air(sender, receiver)
    air.run(3)
    for length in range(140):
        payload = bytes([length]) * length
        for topic_id in (1, 2, 1) if length % 3 == 0 else (1,):
            sender.end.messages.submit(topic_id, payload, air.now)
        air.now += 1.0
        air.run(0.3)
        (scan, *more) = [event for event in came(receiver, payload) if event.topic_id == 1]
        assert len(more) == (length % 3 == 0)
        for event in (scan, *more):
            assert 1.0 <= event.age_s < 1.4 * 17 / 16
    assert len(told(sender)) >= 140


@pytest.mark.parametrize("mode", MODES)
def test_who_has_not_waited_or_is_never_too_old_says_nothing(mode: SealMode) -> None:
    """A link that is full of messages without a deadline, and one with a deadline that does not wait."""
    sender = Robot(1, rows(SCAN, text=SendOptions()), mode=mode)
    air = Air(sender, Robot(2, mode=mode))
    for n in range(100):
        sender.end.messages.submit(0, b"odom %d" % n, air.now)
        for _ in range(6):
            sender.end.messages.submit(2, b"text %d" % n * 20, air.now)
        air.run(0.1)
    assert sender.end.messages.queued()[2] > 10
    assert not told(sender)
    for n in range(20):
        sender.end.messages.submit(1, b"scan %d" % n, air.now)
        air.run(WITHIN_S / TUNING.age_part - 3 * SLOT_S if n % 2 else 0.1)
    assert not told(sender)


def test_who_does_not_know_the_entry_skips_it(monkeypatch: pytest.MonkeyPatch) -> None:
    def unknown(name: int, body: bytes, start: int, stop: int) -> Control | None:
        return None if name == control._WAITED else known(name, body, start, stop)

    known = control._read_exchange
    monkeypatch.setattr(control, "_read_exchange", unknown)
    sender, receiver = Robot(1, rows(SCAN)), Robot(2)
    air = Air(sender, receiver, loss=0.2)
    air.run(3)
    for n in range(30):
        sender.end.messages.submit(1, b"%d" % n * 20, air.now)
        air.now += 1.0
        air.run(0.5)
    assert len(receiver.delivered()) == 30
    assert len(told(sender)) >= 30


@pytest.mark.parametrize("length", [4, 200])
def test_what_is_sent_again_to_a_late_robot_is_as_old_as_its_publication(length: int) -> None:
    kept = SendOptions(durability="transient_local", queue="deadline", deadline_s=9.0)
    sender, late = Robot(1, rows(kept)), Robot(3)
    air = Air(sender, Robot(2))
    air.run(3)
    sender.end.messages.submit(1, bytes(length), air.now)
    air.run(3)
    air.robots = [sender, late]
    took = air.run(4, lambda: bool(late.delivered()))
    (event,) = came(late, bytes(length))
    assert 3.0 <= event.age_s <= (3.0 + took) * 17 / 16


def test_what_is_carried_to_a_late_robot_is_as_old_as_its_publication() -> None:
    kept = SendOptions(durability="transient_local", queue="deadline", deadline_s=10.0, to=3)
    line = Line(robot(1, topics=rows(kept)), robot(2), robot(3))
    absent(line, 3)
    line.run(10)
    line.robots[0].end.messages.submit(1, b"goal", line.now)
    begin = line.now
    line.run(5)
    absent(line)
    while b"goal" not in line.robots[2].delivered(1):
        line.run(0.1)
        assert line.now < begin + 10
    (event,) = came(line.robots[2], b"goal")
    assert event.age_s >= 5.0


@pytest.mark.parametrize("mode", MODES)
def test_a_call_counts_from_its_caller(mode: SealMode) -> None:
    rows = Registry([Topic(0, "calls", CALLS_TYPE, SendOptions(queue="deadline", deadline_s=60.0))])
    sender, receiver = Robot(1, rows, mode=mode), Robot(2, mode=mode)
    sender.end.messages.offer(0, offered=True)
    air = Air(sender, receiver)
    air.run(3)
    sender.end.messages.submit(0, b"call", air.now, 4.0)
    hold_back(sender, 2.0, air.run)
    air.run(1.0)
    (event,) = came(receiver, b"call")
    assert event.age_s >= 2.0


@given(st.lists(st.integers(0, 255), min_size=1, max_size=8), st.booleans())
def test_whatever_a_robot_claims_ages_are_finite_and_only_what_has_a_limit_is_too_old(
    codes: list[int], limit: bool
) -> None:
    """An insider: any ages, of messages with a deadline and without, whole and in fragments."""
    sender, receiver = Robot(1, rows(SCAN if limit else SendOptions())), Robot(2)
    air = Air(sender, receiver)
    air.run(1.0)
    claims = dict(enumerate(codes))

    def lie(message: Message, now: float) -> int:  # noqa: ARG001
        return 0 if message.started else claims[int(message.payload[:1])]

    sender.end.messages.packing._age = lie  # type: ignore[method-assign]
    for n in claims:
        sender.end.messages.submit(1, b"%d" % n * (1, 9, 100)[n % 3], air.now)
        if n % 2:
            air.run(0.2)
    air.run(1.0)
    events = [event for event in receiver.events if isinstance(event, Delivered)]
    assert all(0 <= event.age_s < 20_000 for event in events)
    if not limit:
        assert len(events) == len(codes)
    for event in events:
        assert event.age_s >= min(age_of(claims[int(event.payload[:1])]), 9000) - 1e-6


@pytest.mark.parametrize(("seed", "mode"), [(0, "none"), (1, "encrypt"), (2, "encrypt")])
def test_over_random_lines_no_message_comes_later_than_its_deadline_and_an_eighth(mode: SealMode, seed: int) -> None:
    """Robots send nothing for random times. Of what no neighbour of its origin got by repair, the age that is known is
    not less than the truth, but for an eighth of its deadline and the slots that are not counted."""
    rng = random.Random(seed)
    limits = {1: 1.0, 2: 3.0, 3: 8.0}
    options = {f"t{n}": SendOptions(queue="deadline", deadline_s=limit) for n, limit in limits.items()}
    topics = registry(odom=SendOptions(queue="latest"), **options)
    line = Line(*(robot(src_id, mode, topics) for src_id in range(1, 5)))
    given_at: dict[bytes, float] = {}
    seen: list[tuple[Delivered, float]] = []
    repaired: set[bytes] = set()
    for one in line.robots:

        def received(data: bytes, now: float, began: float | None = None, one: Robot = one) -> list[ReceiverEvent]:
            events = Robot.receive(one, data, now, began)
            for event in events:
                if isinstance(event, Delivered) and event.payload in given_at:
                    seen.append((event, now - given_at[event.payload]))
                    if event.repaired and not event.hops:
                        repaired.add(event.payload)
            return events

        one.receive = received  # type: ignore[method-assign]
    line.run(10)
    for n in range(60):
        quiet = [one for one in line.robots if rng.random() < 0.4]
        for one in quiet:
            one.slot = lambda _: None  # type: ignore[assignment,method-assign]
        for one in line.robots:
            topic_id = rng.choice(list(limits))
            payload = b"%d of %d " % (n, one.src_id) * rng.choice((1, 1, 12))
            given_at[payload] = line.now
            one.end.messages.submit(topic_id, payload, line.now)
        line.run(rng.choice((0.2, 0.5, 2.0)))
        for one in quiet:
            del one.slot
    line.run(10)
    assert len(seen) > 200 > 5 * len(repaired)
    for event, age_s in seen:
        if event.payload not in repaired:
            limit_s = limits[event.topic_id]
            assert age_s <= limit_s * (1 + 1 / TUNING.age_part) + AGE_STEP_S + 3 * SLOT_S
            assert event.age_s >= age_s - max(limit_s / TUNING.age_part, AGE_STEP_S) - 3 * SLOT_S


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("kept", [True, False])
def test_a_message_may_wait_at_its_origin_for_longer_than_it_may_be_withheld(mode: SealMode, kept: bool) -> None:
    """Its deadline is longer than ``max_age_s``: robots over hops get it, too. It was submitted long ago, or waits
    since it was published."""
    option = SendOptions(queue="deadline", deadline_s=3 * MAX_AGE_S)
    if kept:
        option = SendOptions(queue="deadline", deadline_s=3 * MAX_AGE_S, durability="transient_local", to=3)
    line = Line(robot(1, mode, rows(option)), *(robot(src_id, mode) for src_id in (2, 3)))
    absent(line, *([3] if kept else []))
    line.run(10)
    messages, waits_s = line.robots[0].end.messages, 1.5 * MAX_AGE_S
    if kept:
        messages.submit(1, b"goal", line.now)
        line.run(waits_s)
        absent(line)
    else:
        messages.submit(1, b"goal", line.now - waits_s)
    line.run(10)
    assert line.robots[2].delivered(1).count(b"goal") == 1
