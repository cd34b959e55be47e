"""Reliable topics for all, with relaying on: what arrives with it off arrives with it on, too, once and in order."""

from __future__ import annotations

import random
from collections.abc import Callable
from math import inf

import pytest

from gr_ros2.link.events import SentPacket
from gr_ros2.link.queues import PublisherQos
from gr_ros2.link.v1.decoder import RepairDecoder
from gr_ros2.link.v1.order import ALL, Order, Ready
from gr_ros2.link.v1.report_slots import MASK_LEN
from gr_ros2.link.v1.sealing import SealMode
from gr_ros2.link.v1.sent_on import REPAIRED_S
from gr_ros2.settings.config import SendOptions
from gr_ros2.wire.control import Ask
from gr_ros2.wire.v1 import PacketV1, write_body
from tests.link.v1.air import Robot, registry
from tests.link.v1.test_relaying import Line, robot

TOPICS = registry(odom=SendOptions(queue="latest"), goal=SendOptions())
LATE = registry(odom=SendOptions(queue="latest"), map=SendOptions(durability="transient_local"))
Apart = Callable[[int, int], bool]
"""Whether two robots are out of reach of each other now."""


class Cell(Line):
    """Robots of which each hears all others, unless ``apart`` says otherwise."""

    apart: Apart = staticmethod(lambda _, __: False)  # type: ignore[assignment]

    def near(self, one: int) -> list[int]:
        return [other for other in range(len(self.robots)) if other != one and not self.apart(one, other)]


def cell(mode: SealMode, loss: float, *, relay: bool = True) -> Cell:
    met = Cell(*(robot(src_id, mode, TOPICS, relay=relay) for src_id in (1, 2, 3)), loss=loss)
    met.run(5)
    return met


def talk(cell: Cell, count: int, after: int = 0) -> list[bytes]:
    """Every robot publishes so many goals."""
    goals = [b"goal %d" % n for n in range(after, after + count)]
    for goal in goals:
        for one in cell.robots:
            one.end.messages.submit(1, goal, cell.now)
        cell.run(0.3)
    return goals


def came(one: Robot, src_id: int) -> list[bytes]:
    return [payload for payload in one.delivered(src_id) if payload.startswith(b"goal")]


def whole(line: Line, goals: list[bytes]) -> bool:
    """Whether all robots have all goals of all others, once and in order."""
    return all(came(one, other.src_id) == goals for one in line.robots for other in line.robots if other is not one)


def rest(line: Line, seconds: float, goals: list[bytes]) -> None:
    """At most so long, until all goals are there, and a while in which nothing is to come twice."""
    end = line.now + seconds
    while line.now < end and not whole(line, goals):
        line.run(1)
    line.run(3)


@pytest.mark.parametrize(("loss", "mode"), [(0.0, "encrypt"), (0.1, "none"), (0.2, "encrypt"), (0.3, "none")])
def test_a_relayed_message_neither_overtakes_nor_delays_what_repair_brings(loss: float, mode: SealMode) -> None:
    everybody = cell(mode, loss)
    goals = talk(everybody, 100)
    everybody.run(6)
    assert whole(everybody, goals)


@pytest.mark.parametrize(("mode", "seed"), [("none", 1), ("encrypt", 1), ("encrypt", 9)])
def test_short_packets_that_relay_leave_turns_for_repairs_and_reports(mode: SealMode, seed: int) -> None:
    """A mask of a repair fits beside them for 64 packets at most, and two of three packets are not worth a repair. With
    seed 9 two robots wait in vain for packets beyond the window of a repair."""
    everybody = Cell(*(robot(src_id, mode, TOPICS, packet_len=64) for src_id in (1, 2, 3, 4)), loss=0.3)
    everybody._rng = random.Random(seed)
    everybody.invariant.bound = 300
    everybody.run(5)
    goals = [b"goal %29d" % n for n in range(40)]
    for goal in goals:
        for one in everybody.robots:
            one.end.messages.submit(1, goal, everybody.now)
        everybody.run(0.8)
    rest(everybody, 20, goals)
    assert whole(everybody, goals)


def test_requests_leave_the_mask_of_a_repair_its_room() -> None:
    """They filled it where packets are short, so that repairs named everything in their span, what is over too."""
    everybody = Cell(*(robot(src_id, "encrypt", TOPICS, packet_len=64) for src_id in (1, 2, 3)), loss=0.4)
    for again in (everybody.robots[2], everybody.robots[1]):
        for number in range(60):
            for one in everybody.robots:
                one.end.messages.submit(1, b"goal %40d" % number, everybody.now)
            everybody.run(0.3)
        again.start()
    everybody.run(10)
    events = [event for one in everybody.robots for event in one.events if isinstance(event, SentPacket)]
    new = [event.packet for event in events if event.entries and event.number > 8 * MASK_LEN]
    room = everybody.robots[0].end._writer.room
    bodies = [packet.body for packet in new if isinstance(packet, PacketV1)]
    asking = [body for body in bodies if any(isinstance(entry, Ask) for entry in body)]
    assert asking
    assert max(len(write_body(body, room)) for body in bodies) <= room - MASK_LEN


def test_a_robot_out_of_reach_does_not_delay_rare_messages_to_another_one() -> None:
    """Since it lacks an old message, no repair says of all newer packets which of them need not be waited for."""
    topics = registry(odom=SendOptions(queue="latest", reliability="best_effort"), goal=SendOptions())
    everybody = Cell(*(robot(src_id, "encrypt", topics, relay=False) for src_id in (1, 2, 3)), loss=0.2)
    one, two, _ = everybody.robots
    everybody.run(6)
    everybody.apart = lambda one, other: 2 in (one, other)
    one.end.messages.submit(1, b"goal that robot 3 lacks", everybody.now)
    everybody.run(14)
    for goal in (b"goal 1", b"goal 2", b"goal 3"):
        one.end.messages.submit(1, goal, everybody.now)
        everybody.run(4)
        assert goal in two.delivered(1)
        for _ in range(300):
            one.end.messages.submit(0, b"odometry", everybody.now)
            everybody.run(0.1)


def one_way_first(now: float, one: int, other: int) -> bool:
    """Robot 3 is heard by others again 3 s before it hears them."""
    return (one == 2 and 10 <= now < 17) or (other == 2 and 10 <= now < 14)


PATTERNS: dict[str, Callable[[float, int, int], bool]] = {
    "from all": lambda now, one, other: 10 <= now < 17 and 2 in (one, other),  # it enters the slots anew after 2 s
    "from one, whom a third robot hears": lambda now, one, other: 10 <= now < 18 and {one, other} == {0, 2},
    "one way first": one_way_first,
    "again and again": lambda now, one, other: now % 5 < 2 and one != int(now / 5) % 3 != other,
}


@pytest.mark.parametrize(
    ("pattern", "relay"), [*((pattern, True) for pattern in PATTERNS), ("from all", False), ("again and again", False)]
)
def test_some_seconds_out_of_reach_cost_nothing(pattern: str, relay: bool) -> None:
    everybody = cell("encrypt", 0.1, relay=relay)
    everybody.apart = lambda one, other: PATTERNS[pattern](everybody.now, one, other)
    goals = talk(everybody, 80)
    everybody.apart = lambda _, __: False
    rest(everybody, 30, goals)
    assert whole(everybody, goals)


@pytest.mark.parametrize("mode", ["none", "encrypt"])
def test_what_came_over_others_is_not_repaired_when_its_origin_is_heard_again(mode: SealMode) -> None:
    """New messages would wait for it, almost as long as the two were apart."""
    everybody = cell(mode, 0.2)
    everybody.apart = lambda one, other: {one, other} == {0, 2}
    goals = talk(everybody, 130)
    everybody.apart = lambda _, __: False
    goals += talk(everybody, 1, after=len(goals))
    met = everybody.now
    while not whole(everybody, goals) and everybody.now < met + 60:
        everybody.run(0.5)
    assert everybody.now - met < 10


def test_a_robot_that_starts_again_takes_nothing_from_the_others() -> None:
    everybody = cell("encrypt", 0.2)
    first, other, again = everybody.robots
    goals = talk(everybody, 30)
    again.start()
    later = talk(everybody, 40, after=30)
    everybody.run(10)
    assert came(first, 2) == came(other, 1) == goals + later
    of_its_new_start = [goal for goal in came(again, 1) if goal in later]
    assert of_its_new_start == later[-len(of_its_new_start) :] and len(of_its_new_start) >= 30
    assert came(first, 3)[-40:] == later == came(other, 3)[-40:]


def test_what_came_over_others_is_not_false_because_a_packet_of_its_origin_comes_late() -> None:
    """It was held back: the messages were made after it."""
    everybody = cell("encrypt", 0.0)
    first, _, third = everybody.robots
    goals = talk(everybody, 10)
    everybody.apart = lambda one, other: {one, other} == {0, 2}
    goals += talk(everybody, 4, after=len(goals))
    held: list[bytes] = []
    send = first.slot

    def slot(now: float) -> bytes | None:
        data = send(now)
        held.extend([data] if data is not None else [])
        return data

    first.slot = slot  # type: ignore[method-assign]
    goals += talk(everybody, 30, after=len(goals))
    third.receive(held[3], everybody.now, everybody.now)
    goals += talk(everybody, 20, after=len(goals))
    rest(everybody, 30, goals)
    assert whole(everybody, goals)
    assert third.end.received.lost[1, 1, "damaged"] == 0


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(6))
def test_what_a_third_robot_hears_comes_out_once_and_in_order(seed: int) -> None:
    """Two robots are out of each other's reach for 5 to 60 s, or for good."""
    rng = random.Random(seed)
    count, loss, away_s = rng.choice([3, 4]), rng.choice([0.0, 0.1, 0.3]), rng.choice([5, 12, 30, 60])
    modes: list[SealMode] = ["none", "encrypt"]
    everybody = Cell(*(robot(src_id, modes[seed % 2], TOPICS) for src_id in range(1, count + 1)))
    everybody._loss = loss
    everybody.run(5)
    goals = talk(everybody, 10)
    pair = set(rng.sample(range(count), 2))
    everybody.apart = lambda one, other: {one, other} == pair
    goals += talk(everybody, int(away_s / 0.3), after=len(goals))
    if seed % 3:
        everybody.apart = lambda _, __: False
    goals += talk(everybody, 10, after=len(goals))
    rest(everybody, 30, goals)
    assert whole(everybody, goals)


@pytest.mark.slow
def test_all_of_a_reliable_topic_crosses_a_line() -> None:
    line = Line(*(robot(src_id, "encrypt", TOPICS) for src_id in (1, 2, 3, 4)), loss=0.2)
    line.run(15)
    goals = [b"goal %d" % n for n in range(40)]
    for goal in goals:
        for one in line.robots:
            one.end.messages.submit(1, goal, line.now)
        line.run(0.5)
    rest(line, 30, goals)
    assert whole(line, goals)


@pytest.mark.slow
@pytest.mark.parametrize(("loss", "mode"), [(0.1, "none"), (0.3, "encrypt")])
def test_long_messages_cross_a_line_in_one_try(loss: float, mode: SealMode) -> None:
    """What of them is lost is repaired hop by hop, however long that takes; nobody sends them anew meanwhile."""
    line = Line(*(robot(src_id, mode, TOPICS) for src_id in (1, 2, 3)), loss=loss)
    line.run(15)
    goals = [(b"goal %d " % n).ljust(1000, b"x") for n in range(8)]
    relayed = line.robots[1].end._receiving.relaying.sent_on.relayed  # type: ignore[union-attr]
    before = relayed[1, 1]
    for goal in goals:
        line.robots[0].end.messages.submit(1, goal, line.now)
        line.run(2)
    end = line.now + 60
    while line.now < end and not came(line.robots[1], 1) == came(line.robots[2], 1) == goals:
        line.run(1)
    line.run(REPAIRED_S)
    assert came(line.robots[1], 1) == came(line.robots[2], 1) == goals
    assert relayed[1, 1] - before <= len(goals) + 1


@pytest.mark.parametrize("relay", [False, True])
def test_what_its_origin_has_given_up_does_not_stop_those_who_hear_others(relay: bool) -> None:
    """A lifespan passes while a robot is out of reach of all: what is left comes out."""
    topics = registry(odom=SendOptions(queue="latest"), goal=SendOptions(deadline_s=8.0))
    everybody = Cell(*(robot(src_id, "encrypt", topics, relay=relay) for src_id in (1, 2, 3)), loss=0.1)
    everybody.run(5)
    goals = talk(everybody, 10)
    everybody.apart = lambda one, other: 2 in (one, other)
    goals += talk(everybody, 60, after=len(goals))
    everybody.apart = (lambda one, other: {one, other} == {0, 2}) if relay else (lambda _, __: False)
    goals += talk(everybody, 20, after=len(goals))
    everybody.run(10)
    got = came(everybody.robots[2], 1)
    assert got == [goal for goal in goals if goal in set(got)]
    assert got[-15:] == goals[-15:] and goals[40] not in got


def test_what_was_relayed_before_its_table_came_comes_out() -> None:
    """It is not noted as here, so the robot that has it sends it again."""
    for seed in range(3):
        line = Line(robot(1, "encrypt", LATE), robot(2, "encrypt"), loss=0.2)
        line._rng.seed(seed)
        line.run(8)
        line.robots[0].end.messages.submit(1, b"the map", line.now)
        line.run(8)
        line.robots.append(robot(3, "encrypt"))
        line.run(40)
        assert line.robots[2].delivered(1).count(b"the map") == 1


@pytest.mark.parametrize("mode", ["none", "encrypt"])
def test_a_late_robot_over_hops_gets_the_newest_of_every_publisher_of_a_kept_topic(mode: SealMode) -> None:
    """What came first after its table was all that it took."""
    topics = registry(odom=SendOptions(queue="latest"), description=SendOptions())
    line = Line(*(robot(src_id, mode, topics) for src_id in (1, 2)), loss=0.2)
    line.run(8)
    messages = line.robots[0].end.messages
    messages.follow(1, PublisherQos(latched=True, depth=1, count=6, keeps=6))
    said = [b"description %d" % publisher for publisher in range(6)]
    for publisher, description in enumerate(said):
        messages.submit(1, description, line.now, publisher=publisher)
        line.run(0.3)
    line.run(10)
    line.robots.append(robot(3, mode, topics))
    line.run(40)
    assert [payload for payload in line.robots[2].delivered(1) if payload in said] == said


def test_a_robot_that_was_away_has_its_time_to_bring_what_is_missing() -> None:
    """A message waits 60 s for those before it: from when somebody is heard again that may bring them."""
    line = Line(*(robot(src_id, "encrypt", TOPICS) for src_id in (1, 2, 3)))
    line.run(12)
    last, near = line.robots[2], line.near
    relaying = last.end._receiving.relaying
    assert relaying is not None
    order = relaying.far.inboxes[1].order
    number = line.robots[0].end.window.packets.newest + 10_000
    order.wait(Ready(1, (number, 0), b"later", -1, False, False, 1, 2, made=line.now, after=(number - 1, 0)), line.now)
    line.near = lambda one: [other for other in near(one) if 2 not in (one, other)]  # type: ignore[method-assign]
    line.run(45)
    line.near = near  # type: ignore[method-assign]
    line.run(30)
    assert last.delivered(2)
    assert b"later" not in last.delivered(1)
    line.run(60)
    assert b"later" in last.delivered(1)


def test_who_still_repairs_what_was_missing_has_its_time_again() -> None:
    """Of a robot that came back after minutes the oldest packets are repaired first, and may take longer than 60 s."""
    since, missing = [], [True]

    def brings(at: float) -> bool:
        since.append(at)
        return missing[0]

    decoder = RepairDecoder(60, lambda _: True, 1000)
    order = Order(
        decoder, 1, 1.0, sure=10_000, fits=lambda _: True, room=60, quiet_s=3.0, patience_s=60.0, brings=brings
    )
    order.wait(Ready(1, (9, 0), b"later", -1, False, False, 1, 2, after=(8, 0)), 100.0)
    assert not order.settle(159.0)
    assert not order.settle(160.0), "somebody repairs"
    missing[0] = False
    assert order.next_timeout() == 220.0
    assert not order.settle(219.0)
    assert order.settle(220.0)
    assert since == [100.0, 160.0]


def test_a_robot_that_is_heard_now_and_then_does_not_keep_messages_for_ever() -> None:
    order = Order(
        RepairDecoder(60, lambda _: True, 1000),
        1,
        1.0,
        sure=10_000,
        fits=lambda _: True,
        room=60,
        quiet_s=3.0,
        patience_s=60.0,
    )
    order.wait(Ready(1, (9, 0), b"later", -1, False, False, 1, 2, after=(8, 0)), 100.0)
    came = []
    for now in range(120, 500, 20):
        order.wait_anew(now)
        came += order.settle(now)
        if came:
            break
    assert 200 < now <= 420


def test_gaps_that_nobody_fills_pass_together() -> None:
    """One after the other, each took 60 s; a message that has just come has its time all the same."""
    decoder = RepairDecoder(60, lambda _: True, 1000)
    order = Order(decoder, 1, 1.0, sure=10_000, fits=lambda _: True, room=60, quiet_s=3.0, patience_s=60.0)
    for number, after in ((9, 8), (10, 9), (20, 19), (30, 29)):
        order.wait(Ready(1, (number, 0), b"", -1, False, False, 1, 2, after=(after, 0)), 100.0)
    assert not order.settle(110.0)
    order.wait(Ready(1, (40, 0), b"", -1, False, False, 1, 2, after=(39, 0)), 150.0)
    assert order.next_timeout() == 160.0
    assert [ready.order[0] for ready in order.settle(160.0)] == [9, 10, 20, 30]
    assert order.next_timeout() == 210.0
    assert [ready.order[0] for ready in order.settle(210.0)] == [40]


@pytest.mark.parametrize("quiet", [False, True])
def test_a_message_over_others_overtakes_none_that_began_or_ends_in_a_missing_packet(quiet: bool) -> None:
    """It did not bring the packet in which it began: one before it may stand there, or go on there."""
    decoder, part = RepairDecoder(60, lambda _: True, 1000), [None, (2, 1)]
    order = Order(
        decoder,
        1,
        1.0,
        sure=10_000,
        fits=lambda _: True,
        room=60,
        quiet_s=0.0 if quiet else inf,
        incomplete=lambda topic_id: part[topic_id - 1],
    )
    decoder.begin(1)
    decoder.source(1, b"")
    decoder.source(2, b"")
    assert order.up_to(1) == (2, ALL)
    assert order.up_to(2) == (2, 0)
    order.hear(0.0)

    def come(topic_id: int, at: tuple[int, int], after: tuple[int, int]) -> list[Ready]:
        ready = Ready(topic_id, at, b"", -1, False, False, 1, 3, after=after)
        assert not order.passes(ready)
        order.wait(ready, 1.0)
        return order.settle(1.0)

    assert not come(1, (3, 2), (3, 0))
    assert [ready.order for ready in come(1, (3, 0), (2, 4))] == [(3, 0), (3, 2)]
    assert not come(2, (3, 2), (2, 1))
    part[1] = None
    assert [ready.order for ready in order.settle(2.0)] == [(3, 2)]


def test_it_is_known_since_when_the_packet_that_is_repaired_first_is_missing() -> None:
    decoder = RepairDecoder(60, lambda _: True, 1000)
    order = Order(decoder, 1, 1.0, sure=10_000, fits=lambda _: True, room=60)
    order.reported()
    for number, now, missing in ((1, 5.0, ()), (5, 6.0, (2, 4)), (8, 7.0, (6, 7))):
        if missing:
            order.missing(now, *missing)
        decoder.source(number, b"")
        order.settle(now)
    assert order.missing_since() == 6.0
    for number in (2, 3, 4):
        decoder.source(number, b"")
    order.settle(8.0)
    assert order.missing_since() == 7.0
    for number in (6, 7):
        decoder.source(number, b"")
    order.settle(9.0)
    assert order.missing_since() == inf
