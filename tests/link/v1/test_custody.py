"""Messages for one robot that is not heard: they arrive whole, once and in order, over robots that keep them."""

from __future__ import annotations

import random
from typing import Any

import pytest

from gr_ros2.link.events import Delivered, Ended, Gone, Met
from gr_ros2.link.v1 import custody
from gr_ros2.link.v1.custody import Custody
from gr_ros2.link.v1.order import Ready
from gr_ros2.link.v1.sealing import SealMode
from gr_ros2.link.v1.sequences import Sequences
from gr_ros2.relay.memory import Memory
from gr_ros2.settings.config import SendOptions
from gr_ros2.settings.registry import Registry
from gr_ros2.wire.relayed import PLACES, Relayed, read_carried, write_carried
from gr_ros2.wire.v1 import CARRIED_TOPIC, QOS_REPAIR, TABLE_TOPIC, read_header, read_repair_header
from tests.link.v1.air import Robot, registry
from tests.link.v1.test_relaying import ODOM, Line, robot

LAST = 4


def named(last: int = LAST, **options: Any) -> Registry:
    return registry(odom=SendOptions(queue="latest"), goal=SendOptions(to=last, **options), map=SendOptions(to=last))


def custody_of(one: Robot) -> Custody:
    relaying = one.end._receiving.relaying
    assert relaying is not None
    return relaying.custody


def line_of(*robots: Robot, loss: float = 0.1) -> Line:
    """Robots that know each other."""
    line = Line(*robots, loss=loss)
    line.run(12)
    return line


def until(line: Line, seconds: float, condition: Any) -> None:
    end = line.now + seconds
    while not condition() and line.now < end:
        line.run(1)
    assert condition()


def test_the_first_message_waits_for_a_robot_that_was_reached_before_any_was_for_it() -> None:
    line = line_of(robot(1, topics=named(3)), robot(2), robot(3))
    near = line.near
    line.near = lambda one: [other for other in near(one) if 2 not in (one, other)]  # type: ignore[method-assign]
    line.run(30)
    line.robots[0].end.messages.submit(1, b"goal", line.now)
    line.run(5)
    line.near = near  # type: ignore[method-assign]
    until(line, 60, lambda: b"goal" in line.robots[2].delivered(1))


def test_who_gets_a_message_back_does_not_wait_for_a_receipt() -> None:
    """It was handed to a robot that knows no other way; twice as long with each try, that would take minutes."""
    line = line_of(robot(1), robot(2, topics=named()), robot(3), robot(LAST))
    routes = custody_of(line.robots[1]).routes
    routes.note(LAST, 1, 2, line.now)
    routes.doubt(LAST, 3, line.now)
    line.robots[1].end.messages.submit(1, b"goal", line.now)
    line.run(1)
    assert len(custody_of(line.robots[0])) == 1
    until(line, custody.PATIENCE_S - 5, lambda: b"goal" in line.robots[-1].delivered(2))


@pytest.mark.parametrize("mode", ["none", "encrypt"])
def test_goals_arrive_in_order_and_once_beside_a_map_of_many_packets(mode: SealMode) -> None:
    line = line_of(robot(1, mode, named()), *(robot(src_id, mode) for src_id in (2, 3, LAST)))
    whole = random.Random(1).randbytes(2500)
    first, last = line.robots[0], line.robots[-1]
    first.end.messages.submit(2, whole, line.now)
    goals = [b"goal %d" % n for n in range(20)]
    for goal in goals:
        first.end.messages.submit(1, goal, line.now)
        line.run(1)
    until(line, 120, lambda: whole in last.delivered(1) and goals[-1] in last.delivered(1))
    assert [payload for payload in last.delivered(1) if payload.startswith(b"goal")] == goals
    assert last.delivered(1).count(whole) == 1
    assert not any(payload in one.delivered(1) for one in line.robots[1:3] for payload in (*goals, whole))
    until(line, 60, lambda: not any(len(custody_of(one)) for one in line.robots))
    assert all(not custody_of(one).held_bytes for one in line.robots)


def test_goals_cross_three_hops_where_the_table_of_their_origin_takes_many_packets_and_a_third_is_lost() -> None:
    rows = {1: named(), 2: ODOM, 3: ODOM, LAST: ODOM}
    line = Line(*(robot(src_id, "encrypt", topics, packet_len=64) for src_id, topics in rows.items()), loss=0.3)
    line._rng = random.Random(2)
    line.run(12)
    goals = [b"goal %d" % n for n in range(24)]
    for goal in goals:
        line.robots[0].end.messages.submit(1, goal, line.now)
        line.run(1)
    until(line, 90, lambda: goals[-1] in line.robots[-1].delivered(1))
    assert [payload for payload in line.robots[-1].delivered(1) if payload.startswith(b"goal")] == goals


def test_what_comes_before_the_table_of_its_origin_waits_for_it() -> None:
    """Whoever hands a message on forgets it; 3 packets in 10 are lost, tables among them."""

    def met(one: Robot, other: int) -> bool:
        return any(isinstance(event, Met) and event.src_id == other for event in one.events)

    for seed in range(20):
        line = Line(robot(1, topics=named()), *(robot(src_id) for src_id in (2, 3, LAST)), loss=0.3)
        line._rng = random.Random(seed)
        first, last = line.robots[0], line.robots[-1]
        until(line, 30, lambda first=first: met(first, LAST))
        if not met(last, 1):
            break
    assert not met(last, 1), "its table is there already"
    goals = [b"goal %d" % n for n in range(12)]
    for goal in goals:
        first.end.messages.submit(1, goal, line.now)
        line.run(0.5)
    until(line, 60, lambda: goals[-1] in last.delivered(1))
    assert [payload for payload in last.delivered(1) if payload.startswith(b"goal")] == goals


def test_a_robot_over_others_is_met_and_is_gone_when_nothing_of_it_comes() -> None:
    line = line_of(*(robot(src_id) for src_id in (1, 2, 3)), loss=0.0)
    first, last = line.robots[0], line.robots[2]
    assert [event.boot for event in first.events if isinstance(event, Met) and event.src_id == 3] == [last.boot]
    assert [(one.robot, one.hops, one.over) for one in first.end.peers(line.now)] == [(3, 1, 2), (2, 0, None)]
    line.robots.pop()
    line.run(30)
    assert [one.robot for one in first.end.peers(line.now)] == [2]
    assert [event.boot for event in first.events if isinstance(event, Gone) and event.src_id == 3] == [last.boot]


def test_what_the_next_robot_has_not_taken_goes_over_another_one() -> None:
    """1 hears 2 and 3, which hear 4; 2 leaves in the middle of the map."""
    line = line_of(robot(1, topics=named()), *(robot(src_id) for src_id in (2, 3, LAST)), loss=0.0)
    heard = {0: [1, 2], 1: [0, 3], 2: [0, 3], 3: [1, 2]}
    line.near = lambda one: heard[one]  # type: ignore[method-assign]
    line.run(20)
    whole = random.Random(1).randbytes(6000)
    line.robots[0].end.messages.submit(2, whole, line.now)
    line.run(3)
    assert len(custody_of(line.robots[0])) == 1
    (taker,) = {held.taker for held in custody_of(line.robots[0])._held.values()}
    gone = taker - 1
    heard.update({gone: [], 0: [3 - gone], 3: [3 - gone]})
    until(line, 60, lambda: whole in line.robots[-1].delivered(1))
    assert line.robots[-1].delivered(1).count(whole) == 1


def test_a_kept_message_is_sent_to_a_robot_that_comes_within_reach_of_others() -> None:
    rows = registry(odom=SendOptions(queue="latest"), map=SendOptions(to=LAST, durability="transient_local"))
    line = Line(robot(1, topics=rows), *(robot(src_id) for src_id in (2, 3)))
    line.run(8)
    line.robots[0].end.messages.submit(1, b"the map", line.now)
    line.run(8)
    line.robots.append(robot(LAST))
    until(line, 60, lambda: b"the map" in line.robots[-1].delivered(1))


def test_without_the_key_nobody_takes_messages_on_or_hands_them_over() -> None:
    line = line_of(robot(1, "encrypt", named()), robot(2, "encrypt"), robot(3), robot(LAST, "encrypt"), loss=0.0)
    line.robots[0].end.messages.submit(1, b"go", line.now)
    line.run(20)
    assert not line.robots[-1].delivered(1)
    forged = line_of(robot(1, topics=named(3)), robot(2, "encrypt"), robot(3, "encrypt"), loss=0.0)
    forged.robots[0].end.messages.submit(1, b"go", forged.now)
    forged.run(20)
    assert not forged.robots[2].delivered(1)
    assert not len(custody_of(forged.robots[1]))


def test_what_is_held_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    """The way ends at 3: it holds what it took for 4, and the oldest is lost."""
    monkeypatch.setattr(custody, "MOST_HELD", 5)
    line = line_of(robot(1, topics=named()), *(robot(src_id) for src_id in (2, 3, LAST)), loss=0.0)
    line.near = lambda one: [other for other in (one - 1, one + 1) if 0 <= other < 3 and one < 3]  # type: ignore[method-assign]
    for n in range(12):
        line.robots[0].end.messages.submit(1, b"goal %d" % n, line.now)
        line.run(0.6)
    line.run(10)
    held = custody_of(line.robots[2])
    assert len(held) <= 5
    assert line.robots[2].end.received.dropped["custody_full"] + len(held) >= 5


def test_a_message_with_a_deadline_is_not_handed_on_after_it() -> None:
    rows = named(queue="deadline", deadline_s=4.0)
    line = line_of(robot(1, topics=rows), *(robot(src_id) for src_id in (2, 3, LAST)), loss=0.0)
    line.near = lambda one: []  # type: ignore[method-assign]  # noqa: ARG005
    for n in range(400):
        line.robots[0].end.messages.submit(1, b"goal %d" % n, line.now)
    line.run(15)
    assert not len(custody_of(line.robots[0]))
    assert line.robots[0].end.sent.refused[1, "stale"]


def test_what_is_kept_stays_in_order_however_many_after_it_are_given_up() -> None:
    """The goals have 2 s each, and the first one an hour. Of those that are kept, the newest may arrive first."""
    line = line_of(robot(1, topics=named(3, queue="deadline", deadline_s=3600.0)), robot(2), robot(3), loss=0.0)
    messages = line.robots[0].end.messages
    line.near = lambda one: [1 - one] if one < 2 else []  # type: ignore[method-assign]
    messages.submit(1, b"first", line.now)
    for n in range(PLACES + 10):
        messages.submit(1, b"goal %d" % n, line.now, 2.0)
        line.run(0.5)
    here, kept = Sequences[bytes](Memory(100_000).share()), custody_of(line.robots[0])
    (own,) = kept._own.values()
    for held in reversed(own):
        held.taker = 2
        message = read_carried(kept._written(held, line.now))[1]
        here.take(message, message.payload, 0.0, 0.0)
    assert here.due(1, own[0].message.start) == [held.message.payload for held in own]
    assert own[0].message.payload == b"first"


def told(one: Robot) -> list[bool]:
    """Of each own message that has ended, whether it has come."""
    return [event.arrived for event in one.events if isinstance(event, Ended)]


@pytest.mark.parametrize("fails", [2, 3])
def test_what_a_robot_took_on_and_lost_when_it_started_again_comes_all_the_same(fails: int) -> None:
    """It took 24 goals on while it did not hear the next one; robot 3 is not heard by robot 1."""
    line = line_of(robot(1, "encrypt", named()), *(robot(src_id, "encrypt") for src_id in (2, 3, LAST)))
    first, last, forgets = line.robots[0], line.robots[-1], line.robots[fails - 1]
    near = line.near
    line.near = lambda one: [other for other in near(one) if {one, other} != {fails - 1, fails}]  # type: ignore[method-assign]
    goals = [b"goal %d" % n for n in range(24)]
    for goal in goals:
        first.end.messages.submit(1, goal, line.now)
        line.run(0.5)
    until(line, 30, lambda: len(custody_of(forgets)) == 24)
    forgets.start()
    line.near = near  # type: ignore[method-assign]
    until(line, 120, lambda: len(told(first)) == 24)
    assert [payload for payload in last.delivered(1) if payload.startswith(b"goal")] == goals
    assert told(first) == [True] * 24
    until(line, 30, lambda: not any(len(custody_of(one)) for one in line.robots))


def test_a_robot_that_claims_to_be_near_keeps_nothing_back(monkeypatch: pytest.MonkeyPatch) -> None:
    """1 hears 2 and 3. 3 hears 4, and 2 only says so: it confirms what it takes, and sends nothing on."""
    line = Line(robot(1, topics=named()), *(robot(src_id) for src_id in (2, 3, LAST)), loss=0.1)
    heard = {0: [1, 2], 1: [0], 2: [0, 3], 3: [2]}
    line.near = lambda one: heard[one]  # type: ignore[method-assign]
    line.run(15)
    first, liar, last = line.robots[0], line.robots[1], line.robots[-1]
    taken: list[Relayed] = []
    monkeypatch.setattr(custody_of(liar), "take", lambda message, *_, **__: taken.append(message))
    goals = [b"goal %d" % n for n in range(10)]
    for goal in goals:
        custody_of(first).routes.note(LAST, liar.src_id, 1, line.now)
        first.end.messages.submit(1, goal, line.now)
        line.run(1)
    until(line, 120, lambda: len(told(first)) == 10)
    assert len(taken) >= 10
    assert [payload for payload in last.delivered(1) if payload.startswith(b"goal")] == goals
    assert told(first) == [True] * 10


@pytest.mark.parametrize("hops", [1, 2])
def test_the_end_of_a_message_is_told_also_if_it_is_of_no_more_use(hops: int) -> None:
    """The robot for which it is is heard, or over another one."""
    rows = named(hops + 1, queue="deadline", deadline_s=8.0)
    line = line_of(robot(1, topics=rows), *(robot(src_id) for src_id in range(2, hops + 2)), loss=0.0)
    first = line.robots[0]
    first.end.messages.submit(1, b"goal", line.now)
    until(line, 10, lambda: told(first) == [True])
    assert first.end.sent.ended == {(1, True): 1}
    line.near = lambda one: [other for other in (one - 1, one + 1) if 0 <= other < hops and one < hops]  # type: ignore[method-assign]
    first.end.messages.submit(1, b"too late", line.now)
    line.run(12)
    assert told(first) == [True, False]
    line.near = Line.near.__get__(line)  # type: ignore[method-assign]
    first.end.messages.submit(1, b"goal again", line.now)
    until(line, 60, lambda: told(first) == [True, False, True])
    until(line, 60, lambda: b"goal again" in line.robots[-1].delivered(1))


def test_what_waits_in_order_at_a_robot_that_starts_again_has_not_come() -> None:
    """All packets of the goals are there but the first, for which they wait, when robot 2 starts again."""
    line = line_of(robot(1, topics=named(2)), robot(2), loss=0.0)
    first, last = line.robots
    missing, receive = first.end.window.packets.newest + 1, last.receive

    def lossy(data: bytes, now: float, began: float | None = None) -> Any:
        header = read_header(data, 96)
        lost = header.number == missing if header.qos != QOS_REPAIR else read_repair_header(data, header.size, 96).mask
        return [] if lost else receive(data, now, began)

    last.receive = lossy  # type: ignore[method-assign]
    goals = [b"goal %d" % n for n in range(10)]
    for goal in goals:
        first.end.messages.submit(1, goal, line.now)
        line.run(0.5)
    line.run(2)
    assert not any(payload.startswith(b"goal") for payload in last.delivered(1))
    last.start()
    last.receive = receive  # type: ignore[method-assign]
    until(line, 90, lambda: len(told(first)) == 10)
    assert [payload for payload in last.delivered(1) if payload.startswith(b"goal")] == goals
    assert told(first) == [True] * 10


def test_what_waits_for_the_table_of_its_origin_has_not_come() -> None:
    """Robot 3 hears robot 1, but not its table; what is carried to it over robot 2 is not confirmed before."""
    line = line_of(robot(1, topics=named(3)), *(robot(src_id) for src_id in (2, 3)), loss=0.0)
    last, origin = line.robots[-1], line.robots[0]
    line.near = lambda one: [other for other in range(3) if other != one]  # type: ignore[method-assign]
    line.run(3)
    relaying = last.end._receiving.relaying
    assert relaying is not None
    announced = last.end.neighbours.all[1].inbox.announced
    table, announced.topics = announced.topics, {}
    said = Relayed(
        1, origin.boot & 0xFFFF, last.end.neighbours.all[1].inbox.newest, 128, 1, 1, b"goal", dst_id=3, age=0
    )
    carried = Ready(CARRIED_TOPIC, (1, 0), write_carried(3, said), 0, False, False, made=line.now)
    relaying.receive(2, carried, line.now)
    assert not custody_of(last)._receipts
    announced.topics = table
    relaying.direct(1, origin.boot, Ready(TABLE_TOPIC, (1, 0), b"", 0, False, False, made=line.now), line.now)
    assert [event.payload for event in relaying.far._outcomes.take() if isinstance(event, Delivered)] == [b"goal"]
    assert list(custody_of(last)._receipts) == [1]
