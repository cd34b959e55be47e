"""An earlier start of a robot does not come back, however late something of it arrives over others."""

from __future__ import annotations

import pytest

from gr_ros2.link.events import Delivered
from gr_ros2.link.v1.order import Ready
from gr_ros2.link.v1.sealing import SealMode
from gr_ros2.relay.robots import KNOWN_S, QUIET_S
from gr_ros2.wire.ages import age_code
from gr_ros2.wire.relayed import (
    Relayed,
    write_relayed,
)
from gr_ros2.wire.v1 import RELAYED_TOPIC
from tests.link.v1.air import Robot
from tests.link.v1.test_ages import MODES, absent, relaying_of
from tests.link.v1.test_relaying import Line, robot
from tests.link.v1.test_trust import ROW, table


def brought(one: Robot, said: Relayed, now: float, age_s: float = 0.0) -> list[bytes]:
    """What comes out of a message that robot 2 brings and that was made so many s ago."""
    relaying = relaying_of(one)
    message = write_relayed(said._replace(age=age_code(age_s)))
    relaying.receive(2, Ready(RELAYED_TOPIC, (said.number, 0), message, 0, False, False, made=now), now)
    return [event.payload for event in relaying.far._outcomes.take() if isinstance(event, Delivered)]


def odom(origin: int, boot: int, number: int, payload: bytes) -> Relayed:
    return Relayed(origin, boot & 0xFFFF, number, 0, 0, 1, payload)


@pytest.mark.parametrize(
    ("silent_s", "mode"),
    [(16.0, "none"), (QUIET_S + 1, "encrypt"), (KNOWN_S - 5, "none"), (KNOWN_S + 10, "encrypt")],
)
def test_a_late_table_of_an_earlier_start_takes_no_place(mode: SealMode, silent_s: float) -> None:
    line = Line(robot(2, mode), robot(3, mode))
    line.run(5)
    three, now = line.robots[1], line.now
    old, new = table(1, 1000, 5, ROW), table(1, 2000, 1, ROW)
    brought(three, old, now)
    assert brought(three, odom(1, 1000, 9, b"old"), now) == [b"old"]
    brought(three, new, now + 5)
    assert brought(three, odom(1, 2000, 2, b"new"), now + 5) == [b"new"]
    line.now += silent_s
    line._messages = int(line.now / 0.3)
    line.run(6)
    age_s = line.now - now
    brought(three, old._replace(number=6), line.now, age_s)
    assert brought(three, odom(1, 1000, 10, b"old"), line.now, age_s) == []
    known = relaying_of(three).far.present(1)
    assert known is None or known.boot == 2000


@pytest.mark.parametrize("mode", MODES)
def test_a_late_table_of_a_start_before_that_of_a_robot_that_was_heard_takes_no_place(mode: SealMode) -> None:
    line = Line(*(robot(src_id, mode) for src_id in (1, 2, 3)))
    line.near = lambda one: [other for other in range(3) if other != one]  # type: ignore[method-assign]
    line.run(10)
    old, at = line.robots[0].boot, line.now
    line.robots[0].start()
    line.run(10)
    absent(line, 1)
    line.run(40)
    three, age_s = line.robots[2], line.now - at
    brought(three, table(1, old, 9999, ROW), line.now, age_s)
    assert brought(three, odom(1, old, 10_000, b"old"), line.now, age_s) == []


@pytest.mark.parametrize("mode", MODES)
def test_what_waits_of_an_earlier_start_comes_out_before_the_new_one(mode: SealMode) -> None:
    """Robot 1 is heard, then gone; its new start is known over others. What was heard of the old one is over then."""
    line = Line(*(robot(src_id, mode) for src_id in (1, 2, 3)))
    line.near = lambda one: [other for other in range(3) if other != one]  # type: ignore[method-assign]
    line.run(10)
    old = line.robots[0].boot
    absent(line, 1)
    line.run(15)
    three = line.robots[2]
    brought(three, table(1, old + 1, 1, ROW), line.now)
    assert brought(three, odom(1, old + 1, 2, b"new"), line.now) == [b"new"]
    assert brought(three, odom(1, old, 10_000, b"old"), line.now) == []


@pytest.mark.parametrize("mode", MODES)
def test_what_has_come_of_a_start_is_known_until_the_next_one_is_proven(mode: SealMode) -> None:
    """Robot 3 hears the first hello of a new start of robot 1, which never hears it; others go on with the old one."""
    line = Line(*(robot(src_id, mode) for src_id in (1, 2, 3)))
    line.near = lambda one: [other for other in range(3) if other != one]  # type: ignore[method-assign]
    line.run(10)
    one, three = line.robots[0], line.robots[2]
    old = one.boot
    absent(line, 1)
    line.run(20)
    newest = relaying_of(three)._neighbours.all[1].inbox.newest
    brought(three, table(1, old, newest + 1, ROW), line.now)
    assert brought(three, odom(1, old, newest + 2, b"once"), line.now) == [b"once"]
    one.start()
    while relaying_of(three)._neighbours.all[1].boot == old:
        line.now += 0.05
        if (data := one.slot(line.now)) is not None:
            three.receive(data, line.now, line.now)
    brought(three, table(1, old, newest + 3, ROW), line.now)
    assert brought(three, odom(1, old, newest + 2, b"once"), line.now) == []
