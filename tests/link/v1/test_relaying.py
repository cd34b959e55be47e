"""Messages of robots that are not heard directly: who gets them, once, whole and decoded, and who does not."""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Iterator
from math import inf
from typing import Any

import pytest

from gr_ros2.core.tuning import Tuning
from gr_ros2.gr.factory import message_codec
from gr_ros2.link.events import Announced, Delivered
from gr_ros2.link.v1.sealing import SealMode
from gr_ros2.link.v1.sent_on import REPAIRED_S, SentOn, ToPass
from gr_ros2.link.v1.sent_topics import RELAYED_TABLES, SentTopics
from gr_ros2.mac import Slots
from gr_ros2.relay.gain import Gains
from gr_ros2.relay.memory import Memory
from gr_ros2.relay.robots import OtherRobots
from gr_ros2.settings.config import SendOptions
from gr_ros2.settings.registry import Registry, Topic
from gr_ros2.wire import AnnouncedTopic
from gr_ros2.wire.relayed import Relayed, read_relayed
from gr_ros2.wire.v1 import TABLE_TOPIC
from tests.link.v1.air import SLOT_S, Robot, registry
from tests.link.v1.invariants import PacketsEnd

STEPS = 8
"""Moments of a slot at which a packet may leave."""
ODOM = registry(odom=SendOptions(queue="latest"))


def robot(src_id: int, mode: SealMode = "none", topics: Registry = ODOM, **settings: Any) -> Robot:
    access = Slots(src_id, SLOT_S, random.Random(src_id), period_s=0.0)
    common = {"packet_len": 96, "hears": True, "relay": True}
    return Robot(src_id, topics, mode=mode, access=access, **{**common, **settings})


class Line:
    """Robots in a row of which each hears the next on both sides; packets that overlap destroy each other."""

    def __init__(self, *robots: Robot, loss: float = 0.0) -> None:
        self.robots = list(robots)
        self.now, self._rng, self._loss = 0.0, random.Random(1), loss
        self._messages = self._steps = 0
        self.said: list[tuple[int, bytes]] = []
        self._departures: dict[int, float] = {}
        self.invariant = PacketsEnd(self.robots)

    def near(self, one: int) -> list[int]:
        return [other for other in (one - 1, one + 1) if 0 <= other < len(self.robots)]

    def run(self, seconds: float) -> None:
        """So long; every robot has a new message every 0.3 s."""
        end = self.now + seconds
        self._departures.clear()  # somebody may have said something meanwhile
        while self.now < end:
            if self.now >= 0.3 * self._messages:
                self._messages += 1
                self._departures.clear()
                for one in self.robots:
                    self.said.append((one.src_id, b"%d says %d" % (one.src_id, self._messages)))
                    one.end.messages.submit(0, self.said[-1][1], self.now)
            left = {n: data for n in self._leaving() if (data := self.robots[n].slot(self.now)) is not None}
            for n, one in enumerate(self.robots if left else ()):
                heard = [left[near] for near in self.near(n) if near in left]
                if len(heard) == 1 and n not in left and self._rng.random() >= self._loss:
                    one.receive(heard[0], self.now + SLOT_S, self.now)
                    self._departures.pop(n, None)
            self._steps += 1
            self.now += SLOT_S / STEPS
            if self._steps % STEPS == 0:
                for one in self.robots:
                    one.events += one.end.handle_timeout(self.now)
                self._departures.clear()
                self.invariant.step()

    def _leaving(self) -> Iterator[int]:
        """The robots whose next packet may leave by now. When one may leave changes only with what happens."""
        for n, one in enumerate(self.robots):
            if n not in self._departures:
                departure = one.end.next_departure(credited=True)
                self._departures[n] = inf if departure is None else departure
            if self._departures[n] <= self.now + 1e-9:
                del self._departures[n]
                yield n


@pytest.mark.parametrize("mode", ["none", "authenticate", "encrypt"])
def test_messages_cross_three_robots(mode: SealMode) -> None:
    line = Line(*(robot(src_id, mode) for src_id in range(1, 6)), loss=0.1)
    line.run(30)
    first, last = line.robots[0], line.robots[-1]
    got = last.delivered(1)
    assert len(got) == len(set(got)) >= 15
    assert set(got) <= {payload for src_id, payload in line.said if src_id == 1}
    assert len(first.delivered(5)) >= 15
    assert {event.src_id for event in last.events if isinstance(event, Announced)} == {1, 2, 3, 4}


def test_without_relaying_only_neighbours_are_heard() -> None:
    line = Line(*(robot(src_id, relay=False) for src_id in range(1, 4)))
    line.run(10)
    assert line.robots[2].delivered(2)
    assert not line.robots[2].delivered(1)


def test_a_message_comes_out_once_at_who_hears_it_both_ways() -> None:
    line = Line(*(robot(src_id) for src_id in range(1, 4)), loss=0.2)
    line.near = lambda one: [other for other in range(3) if other != one]  # type: ignore[method-assign]
    line.run(20)
    for one in line.robots:
        keys = [(event.src_id, event.key) for event in one.events if isinstance(event, Delivered)]
        assert len(keys) == len(set(keys)) > 60


def test_where_all_hear_all_next_to_nothing_is_relayed() -> None:
    """Neither their messages nor their tables: otherwise repairs would wait for them."""
    line = Line(*(robot(src_id) for src_id in range(1, 4)))
    line.near = lambda one: [other for other in range(3) if other != one]  # type: ignore[method-assign]
    line.run(10)
    relaying = [one.end._receiving.relaying for one in line.robots]
    before = sum(one.sent_on.relayed.total() for one in relaying if one is not None)
    line.run(20)
    assert sum(one.sent_on.relayed.total() for one in relaying if one is not None) - before < 20


def test_without_the_key_nobody_relays_or_is_relayed() -> None:
    line = Line(robot(1, "encrypt"), robot(2, "encrypt"), robot(3), robot(4, "encrypt"))
    line.run(20)
    assert line.robots[1].delivered(1)
    assert not line.robots[3].delivered()
    assert not line.robots[2].delivered()
    assert {event.src_id for event in line.robots[0].events if isinstance(event, Delivered)} == {2}


def test_a_topic_for_one_robot_comes_out_at_that_one_only_also_over_hops() -> None:
    goal = registry(goal=SendOptions(queue="latest", to=4))
    line = Line(robot(1, topics=goal), *(robot(src_id) for src_id in (2, 3, 4)))
    line.run(20)
    assert [len(one.delivered(1)) > 5 for one in line.robots] == [False, False, False, True]
    there = line.robots[1].end.received
    assert there.dropped["not_for_us"] > 5
    assert not any(reason == "not_for_us" for _, _, reason in there.lost), "nobody misses what is not for them"


def test_packets_for_others_keep_their_slots_and_are_confirmed_by_that_robot_only() -> None:
    """1 and 2 address each other, 3 and 4 all."""
    addressed = {1: 2, 2: 1}
    everybody = [
        robot(src_id, topics=registry(goal=SendOptions()), relay=False, dst_id=addressed.get(src_id, 255))
        for src_id in (1, 2, 3, 4)
    ]
    line = Line(*everybody, loss=0.1)
    line.near = lambda one: [other for other in range(4) if other != one]  # type: ignore[method-assign]
    line.run(30)
    said = [payload for src_id, payload in line.said if src_id == 1]
    got = everybody[1].delivered(1)
    assert got == said[: len(got)] and len(said) - len(got) < 5
    for one in everybody:
        assert isinstance(one.access, Slots)
        assert not one.access.unheard(line.now)
        assert one.access.around.robots.keys() == {1, 2, 3, 4} - {one.src_id}
    assert not everybody[2].delivered(1)
    assert everybody[2].delivered(4)
    assert everybody[0].end.window.peers.all.keys() == {2}
    assert everybody[2].end.received.dropped["not_for_us"] > 100


@pytest.mark.parametrize(("loss", "seed"), [(0.0, 1), (0.3, 3), (0.4, 5)])
def test_tables_of_many_packets_cross_a_line(loss: float, seed: int) -> None:
    """They are of use only whole: they are repaired, have slots for all their packets, and those that a robot lacks go
    first."""
    options = {f"topic_{n}": SendOptions() for n in range(4)}
    line = Line(*(robot(src_id, "encrypt", registry(**options), packet_len=64) for src_id in (1, 2, 3, 4)), loss=loss)
    line._rng.seed(seed)
    line.run(40)
    for one in line.robots:
        assert all(one.end.knows(other.src_id) for other in line.robots if other is not one)


def test_a_table_that_comes_while_another_one_leaves_is_sent_on() -> None:
    gains = Gains(2, OtherRobots())
    for robot_id in (1, 3):
        gains.neighbour(robot_id, 0.0)
    sent_on, topics = SentOn(gains, Counter(), Memory(10_000, 2), Tuning(), repairs=True), SentTopics(None, ())
    topics.relay()
    queue, table = topics[RELAYED_TABLES].queue, Relayed(1, 5, 10, 0, TABLE_TOPIC, 0, b"table" * 40)
    sent_on.take(1, ToPass(table, 0.0, inf), 0.0)
    sent_on.offer(topics, 0.0, 0.0, 100)
    (leaving,) = queue
    leaving.take(50)
    later = table._replace(number=20, payload=b"later" * 40)
    sent_on.take(1, ToPass(later, 1.0, inf), 1.0)
    sent_on.offer(topics, 1.0, 1.0, 100)
    assert [*queue] == [leaving]
    sent_on.left(queue.popleft(), 1.0, lambda _: lambda _robot, _now: False)
    assert leaving.lifetime.expires == 1.0 + REPAIRED_S
    sent_on.offer(topics, 1.0, 1.0, 100)
    assert read_relayed(queue[0].payload).payload == later.payload


def test_frames_are_not_passed_on() -> None:
    """A chain of frames would be of no use to who lacks one of them."""
    topics = registry(odom=SendOptions(queue="latest"), image=SendOptions())
    known = message_codec()

    def decoder_for(rows: tuple[AnnouncedTopic, ...]) -> Any:
        told = [Topic(row.topic_id, row.name, row.type_name) for row in rows]
        return known.of(told, {row.topic_id: row.codec for row in rows})

    made = [robot(src_id, topics=topics, coding=(message_codec(topics), decoder_for)) for src_id in range(1, 4)]
    line = Line(*made)
    camera, near, far = line.robots
    camera.end.frames.begin(1)
    for number in range(30):
        camera.end.frames.submit(1, b"frame %d" % number, line.now, line.now, key=number == 0)
        line.run(0.5)
    frames = [b"frame %d" % number for number in range(30)]
    assert [payload for payload in near.delivered(1) if payload in frames] == frames
    assert len(far.delivered(1)) > 10
    assert not set(far.delivered(1)) & set(frames)
