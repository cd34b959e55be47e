"""Options of a topic that change while messages are under way: nobody gets what is for another robot, and no message of
a reliable topic is lost by the change."""

from __future__ import annotations

import random
from collections import deque
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gr_ros2.core.errors import ConfigError, WireError
from gr_ros2.link.events import Delivered
from gr_ros2.settings.config import SendOptions
from gr_ros2.settings.fields import AUTO
from gr_ros2.settings.registry import MAX_TOPICS
from gr_ros2.wire import FORMATS
from gr_ros2.wire.v1 import BROADCAST, TABLE_TOPIC, Part
from tests.link.v1.air import SLOT_S, Robot, registry
from tests.link.v1.invariants import PacketsEnd
from tests.link.v1.test_custody import line_of
from tests.link.v1.test_relaying import robot

GOAL = SendOptions()


class Sender:
    """Robot 1, which sends topic `goal` to one robot after the other, and what it has said to whom."""

    def __init__(self, one: Robot, topic_id: int = 0) -> None:
        self.end, self.row = one.end, topic_id
        self.said: list[tuple[int, bytes]] = []

    def address(self, to: int, now: float) -> None:
        self.end.next_departure()
        options = SendOptions(to=AUTO if to == BROADCAST else to)
        self.row = self.end.messages.change(self.row, options)[1].topic_id
        self.to, self.now = to, now

    def say(self, now: float) -> None:
        payload = b"goal %d for %d" % (len(self.said), self.to)
        self.said.append((self.to, payload))
        self.end.messages.submit(self.row, payload, now)

    def meant_for(self, robot: int) -> list[bytes]:
        return [payload for to, payload in self.said if to in (robot, BROADCAST)]


class Air:
    """Packets are lost, doubled and late; those with the table of topics are lost far more often, until ``calm``."""

    def __init__(self, *robots: Robot, seed: int, loss: float, table_loss: float) -> None:
        self.robots, self.now, self.calm = robots, 0.0, False
        self.invariant = PacketsEnd(robots)
        self._rng, self._loss, self._table_loss = random.Random(seed), loss, table_loss
        self._under_way: deque[tuple[float, Robot, bytes]] = deque()

    def run(self, seconds: float) -> None:
        end = self.now + seconds
        while self.now < end:
            self.now += SLOT_S
            for one in self.robots:
                data = one.slot(self.now)
                for other in self.robots:
                    if data is not None and other is not one and not self._lost(data):
                        self._under_way.append((self.now + self._rng.choice((1, 1, 1, 5)) * SLOT_S, other, data))
            late = [packet for packet in self._under_way if packet[0] > self.now]
            for _, other, data in (packet for packet in self._under_way if packet[0] <= self.now):
                other.receive(data, self.now)
            self._under_way = deque(late)
            for one in self.robots:
                one.events += one.end.handle_timeout(self.now)
            self.invariant.step()

    def _lost(self, data: bytes) -> bool:
        try:
            entries = FORMATS[1].decode(data, 64).entries
        except WireError:
            entries = ()
        table = any(isinstance(entry, Part) and entry.topic_id == TABLE_TOPIC for entry in entries)
        return not self.calm and self._rng.random() < (self._table_loss if table else self._loss)


CHANGES = st.lists(st.tuples(st.sampled_from((2, 3, 4, BROADCAST)), st.integers(1, 6)), min_size=2, max_size=8)


@settings(max_examples=40, deadline=None)
@given(CHANGES, st.integers(0, 1 << 16), st.sampled_from((0.0, 0.1, 0.3)), st.sampled_from((0.0, 0.9)))
def test_whoever_a_message_is_for_gets_it_and_nobody_else(
    changes: list[tuple[int, int]], seed: int, loss: float, table_loss: float
) -> None:
    one, *others = Robot(1, registry(goal=GOAL)), *(Robot(src_id) for src_id in (2, 3, 4))
    air, sender = Air(one, *others, seed=seed, loss=loss, table_loss=table_loss), Sender(one)
    air.run(1.0)
    for to, count in changes:
        sender.address(to, air.now)
        for _ in range(count):
            sender.say(air.now)
            air.run(0.05)
    air.calm = True
    for _ in range(30):
        air.run(1.0)
        if all(len(other.delivered(1)) == len(sender.meant_for(other.src_id)) for other in others):
            break
    for other in others:
        assert sorted(other.delivered(1)) == sorted(sender.meant_for(other.src_id))
        for topic_id in range(len(one.end.messages.topics or ())):
            of_row = [e.payload for e in other.events if isinstance(e, Delivered) and e.topic_id == topic_id]
            assert of_row == [payload for payload in sender.meant_for(other.src_id) if payload in of_row]


def test_over_hops_goals_reach_the_robot_that_they_were_for() -> None:
    line = line_of(
        robot(1, topics=registry(odom=SendOptions(queue="latest"), goal=SendOptions(to=4))), *map(robot, (2, 3, 4))
    )
    sender = Sender(line.robots[0], 1)
    for to in (4, 3, 2, 4, 2):
        sender.address(to, line.now)
        for _ in range(3):
            sender.say(line.now)
            line.run(0.4)
    line.run(40)
    for other in line.robots[1:]:
        got = [payload for payload in other.delivered(1) if payload.startswith(b"goal")]
        assert sorted(got) == sorted(sender.meant_for(other.src_id))


def test_the_row_of_a_robot_comes_again_and_other_options_change_in_place() -> None:
    one = Robot(1, registry(goal=GOAL))
    messages, sender = one.end.messages, Sender(one)
    rows = []
    for to in (7, 8, 7, BROADCAST):
        sender.address(to, 0.0)
        rows.append(sender.row)
    assert rows == [1, 2, 1, 0]
    _, row = messages.change(0, replace(GOAL, weight=5.0, max_rate=2.0, qos="latency", queue_depth=3, keep_s=60.0))
    assert row.topic_id == 0 and messages.queue(0)[0] == "latest" and messages.depth(0) == 3
    for number in range(4):
        messages.submit(0, b"%d" % number, 0.1 * number)
    assert messages.sent[0].queue[0].weight == 5.0 and messages.sent[0].kept
    assert len(messages.sent[0].queue) == 1


def test_what_cannot_change_is_named_and_so_is_a_full_table() -> None:
    one = Robot(1, registry(goal=GOAL))
    with pytest.raises(ConfigError, match="topic goal: codec cannot change while running; these can: to, qos"):
        one.end.messages.change(0, replace(GOAL, codec="zstd"))
    sender = Sender(one)
    for to in range(MAX_TOPICS - 1):
        sender.address(to, 0.0)
    with pytest.raises(ConfigError, match=f"{MAX_TOPICS + 1} topics; a link carries at most"):
        sender.address(MAX_TOPICS, 0.0)
