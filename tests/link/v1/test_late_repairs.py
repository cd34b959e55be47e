"""A repair may be sent long after the packets in it: it tells neither when they were made nor how far its sender is."""

from __future__ import annotations

import pytest

from gr_ros2.link.events import Delivered
from gr_ros2.link.v1.delivery import DeliveryRules
from gr_ros2.link.v1.endpoint_settings import Settings
from gr_ros2.link.v1.order import Ready
from gr_ros2.link.v1.sealing import SealMode
from gr_ros2.link.v1.writer import SendSlot
from gr_ros2.relay.gain import EXPIRES_S
from gr_ros2.relay.robots import STALE_S, OtherRobots
from gr_ros2.relay.routes import Routes
from gr_ros2.wire.relayed import Relayed, write_relayed
from gr_ros2.wire.v1 import RELAYED_TOPIC
from tests.link.v1.air import SLOT_S, Robot
from tests.link.v1.test_ages import MODES, relaying_of
from tests.link.v1.test_relayed_reliable import Cell, cell


def repair_of(sender: Robot, number: int, now: float) -> bytes:
    """A packet of a sender once more, in a packet for repair."""
    repair = sender.end.window._combination([sender.end.window.packets.records[number]], now)
    assert repair is not None
    return sender.end._writer.repair(repair, SendSlot(now)).data


def over(one: Robot, origin: Robot, number: int, text: bytes, now: float) -> list[bytes]:
    """What comes out when robot 2 brings a message of another one."""
    relaying = relaying_of(one)
    message = Relayed(origin.src_id, origin.boot & 0xFFFF, number, 0, 0, 1, text, age=0)
    relaying.receive(2, Ready(RELAYED_TOPIC, (1, 0), write_relayed(message), 0, False, False, made=now), now)
    return [event.payload for event in relaying.far._outcomes.take() if isinstance(event, Delivered)]


def behind(mode: SealMode) -> tuple[Cell, bytes]:
    """A cell whose robot 3 has heard nothing for 4 s, and a repair of the first goal of robot 1 in that time."""
    everybody = cell(mode, 0.0)
    one = everybody.robots[0]
    everybody.apart = lambda one, other: 2 in (one, other)
    one.end.messages.submit(1, b"goal", everybody.now)
    heard = one.end.window.packets.newest
    everybody.run(4)
    goal = next(number for number in one.end.window.packets.records if number > heard)
    return everybody, repair_of(one, goal, everybody.now)


@pytest.mark.parametrize("mode", MODES)
def test_a_late_repair_makes_no_message_that_came_over_others_come_again(mode: SealMode) -> None:
    everybody, late = behind(mode)
    one, _, three = everybody.robots
    ahead = one.end.window.packets.newest
    assert over(three, one, ahead, b"newest", everybody.now) == [b"newest"]
    three.receive(late, everybody.now + SLOT_S, everybody.now)
    assert over(three, one, ahead, b"newest", everybody.now + SLOT_S) == []
    assert over(three, one, ahead - 1, b"older", everybody.now + SLOT_S) == []


@pytest.mark.parametrize("mode", MODES)
def test_a_late_repair_makes_no_packet_after_it_younger(mode: SealMode) -> None:
    everybody, late = behind(mode)
    three = everybody.robots[2]
    inbox, before = three.end.neighbours.all[1].inbox, everybody.now - 4
    three.receive(late, everybody.now + 20, everybody.now + 20)
    after = Ready(0, (inbox.newest + 1, 0), b"", 0, False, True)
    assert inbox.deliveries.made(after.order[0], everybody.now + 20, repaired=after.repaired) <= before


def test_the_age_of_what_is_repaired_is_unknown_where_nothing_before_it_came() -> None:
    rules = DeliveryRules(Settings(2), {})
    rules.reached(7, 100.0)
    assert rules.made(8, 110.0, repaired=True) == 100.0
    assert rules.made(7, 110.0, repaired=False) == 100.0
    assert rules.made(7, 110.0, repaired=True) < -1000.0


def test_what_is_repaired_is_younger_than_the_last_hello_before_it() -> None:
    rules = DeliveryRules(Settings(2), {})
    rules.stands(6, 90.0)  # the first hello of a robot that was heard
    rules.stands(6, 98.0)
    rules.reached(8, 110.0)
    assert rules.made(7, 110.0, repaired=True) == 98.0
    rules.stands(8, 112.0)
    assert rules.made(8, 120.0, repaired=False) == 110.0
    assert rules.made(9, 120.0, repaired=True) == 112.0


def test_a_late_message_tells_no_way() -> None:
    routes = Routes(OtherRobots())
    routes.note(1, 2, 0, 100.0)
    routes.note(1, 2, 0, 90.0)
    assert routes.over(1, 100.0 + STALE_S, lambda _: True) == 2
    routes.note(1, 3, 1, 100.0 - STALE_S)
    assert routes.over(1, 101.0, lambda via: via == 3) is None


@pytest.mark.parametrize("mode", MODES)
def test_what_a_relay_is_brought_twice_comes_out_once_whatever_its_age(mode: SealMode) -> None:
    everybody, _ = behind(mode)
    one, _, three = everybody.robots
    number, much_later = one.end.window.packets.newest, everybody.now + 2 * EXPIRES_S
    assert over(three, one, number, b"newest", everybody.now) == [b"newest"]
    assert over(three, one, number, b"newest", much_later) == []


def test_a_packet_that_was_held_back_brings_nothing_of_others() -> None:
    """Who has no key records what robot 3 does not hear, and plays it when robot 2 is out of reach."""
    everybody = cell("encrypt", 0.0)
    one, two, three = everybody.robots
    everybody.apart = lambda one, other: {one, other} == {0, 2}
    everybody.run(15)
    held: list[bytes] = []
    slot = two.slot
    two.slot = lambda now: held.append(data) or data if (data := slot(now)) is not None else None  # type: ignore[method-assign,func-returns-value]
    everybody.apart = lambda one, other: 2 in (one, other)
    everybody.run(3)
    two.slot = slot  # type: ignore[method-assign]
    everybody.run(30)
    before = len(three.delivered(1))
    for data in held:
        three.receive(data, everybody.now, everybody.now)
    assert three.end.received.dropped["withheld"]
    assert len(three.delivered(1)) == before
    assert len(three.delivered(2)) > 0 and one.delivered(2)
