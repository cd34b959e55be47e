"""Round trips: what is asked is answered, and loss is counted in each direction."""

from __future__ import annotations

import pytest

from gr_ros2.link import AirPacket
from gr_ros2.link.v1.pings import ANSWER_S, KEPT, Pings
from gr_ros2.wire.control import About, Ping
from tests.link.v1.air import SLOT_S, Air, Robot, registry

ABOUT = About(64, 0xCAFE, 0, b"0.1.0 and more text than a packet has room for, so that it is cut" * 3)


def pair(**settings: object) -> tuple[Air, Robot, Robot]:
    one, two = Robot(1, registry(), **settings), Robot(2, **settings)  # type: ignore[arg-type]
    two.end.pings.about = ABOUT
    one.end.pings.wall_s, two.end.pings.wall_s = 1000.0, 1000.25
    air = Air(one, two)
    air.run(2.0)
    return air, one, two


@pytest.mark.parametrize("mode", ["none", "encrypt"])
def test_a_question_is_answered_with_times_and_what_the_other_end_is(mode: str) -> None:
    air, one, _ = pair(mode=mode)
    for _ in range(20):
        trips = one.end.pings.ask(2, air.now, wants_about=True)
        air.run(0.2)
    assert (trips.asked, trips.answered, trips.arrived, trips.lost_there, trips.lost_back) == (20, 20, 20, 0, 0)
    assert min(trips.round_trips) == pytest.approx(2 * SLOT_S)
    clock = one.end.clock_of(2, air.now)
    assert clock is not None
    assert abs(clock.ahead_s - 0.25) <= clock.error_s <= SLOT_S + 1e-3
    assert clock.jumps == 0
    assert trips.about is not None
    assert trips.about[:3] == ABOUT[:3]
    assert ABOUT.text.startswith(trips.about.text)


def test_loss_is_told_by_direction() -> None:
    air, one, two = pair()
    air.lost = lambda sender, _: air.rng.random() < (0.25 if sender is one else 0.5)
    for _ in range(400):
        trips = one.end.pings.ask(2, air.now)
        air.run(0.15)
    assert trips.lost_there is not None
    assert trips.lost_back is not None
    assert trips.arrived is not None
    assert trips.lost_there / 400 == pytest.approx(0.25, abs=0.07)
    assert trips.lost_back / trips.arrived == pytest.approx(0.5, abs=0.1)
    assert two.end.pings.asked == {}


def test_answers_tell_the_snr_at_the_other_robot() -> None:
    air, one, two = pair()
    trips = one.end.pings.ask(2, air.now)
    for _ in range(20):
        if (data := one.slot(air.now)) is not None:
            two.end.receive(AirPacket(data, snr_db=17.5), air.now)
        if (data := two.slot(air.now)) is not None:
            one.end.receive(AirPacket(data, snr_db=9.0), air.now)
        air.now += 1 / 75
    assert trips.snr_there_db == 17.5


def test_a_flood_of_questions_is_answered_at_a_bounded_rate() -> None:
    pings = Pings(ABOUT)
    answers = 0
    for step in range(1000):
        now = step * ANSWER_S / 10
        for robot in (7, 8, 9):
            pings.receive(robot, 1, Ping(1, step), now)
        answers += len(pings.entries(50, {}, now))
    assert answers <= 1000 / 10 + 1
    assert len(pings._to_answer) <= 3


def test_only_what_was_asked_counts() -> None:
    pings = Pings()
    trips = pings.ask(2, 0.0)
    pings.entries(50, {}, 0.0)
    for answer in (Ping(1, 9, True), Ping(3, 1, True)):
        pings.receive(2, 1, answer, 1.0)
    pings.receive(5, 1, Ping(1, 1, True), 1.0)
    assert (trips.asked, trips.answered, set(pings.asked)) == (1, 0, {2})
    pings.receive(2, 1, Ping(1, 1, True, arrived=1), 1.0)
    pings.receive(2, 1, Ping(1, 1, True, arrived=1), 2.0)
    assert (trips.answered, list(trips.round_trips)) == (1, [1.0])
    for second in range(3, 2 * KEPT):
        pings.ask(2, second)
        pings.ask(2, second + 0.01)
        (question,) = pings.entries(50, {}, second)
        assert isinstance(question, Ping)
        pings.receive(2, 1, Ping(1, question.number, True, arrived=trips.asked), second + 0.5)
        assert pings.entries(50, {}, second + 0.6) == []
    assert len(trips.round_trips) == KEPT
