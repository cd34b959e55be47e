"""Robots hear at different rates: near ones get fast packets, far ones their share of slow ones, nobody starves."""

from __future__ import annotations

import random
from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from heapq import heappop, heappush
from itertools import count, pairwise
from typing import Any

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from gr_ros2.link import AirPacket
from gr_ros2.link.events import Delivered, SentPacket
from gr_ros2.link.rate import Mcs
from gr_ros2.link.v1.audiences import Audiences
from gr_ros2.link.v1.inbox import Inbox
from gr_ros2.link.v1.message import Message
from gr_ros2.link.v1.sealing import SealMode
from gr_ros2.settings.config import SendOptions
from gr_ros2.settings.registry import Registry, Topic
from gr_ros2.wire.control import READS_LEFT_OUT, LeftOut
from tests.link.v1.air import Robot
from tests.link.v1.invariants import PacketsEnd

TABLE = (
    Mcs("slow", 0.016, 0.0, 0.4),
    Mcs("middle", 0.008, 6.0, 0.4),
    Mcs("fast", 0.004, 14.0, 0.4),
)
ODOM, SCAN, STATE, EVENTS = range(4)
LATEST = SendOptions(queue="latest", reliability="best_effort")
TOPICS = Registry(
    [
        Topic(ODOM, "odom", "std_msgs/msg/String", LATEST),
        Topic(SCAN, "scan", "std_msgs/msg/String", LATEST),
        Topic(STATE, "state", "std_msgs/msg/String", LATEST),
        Topic(EVENTS, "events", "std_msgs/msg/String", SendOptions(queue="fifo", reliability="reliable")),
    ]
)
STEP_S = 0.002
LENGTHS = {ODOM: 40, SCAN: 250, STATE: 20, EVENTS: 60}


class Hearing(Robot):
    """A robot that sends with several MCS."""

    mcs_table = TABLE


@dataclass
class Field:
    """One robot that sends, and others that hear it at an SNR of their own and report on a channel of their own.

    :ivar snrs_db: by robot id
    :ivar loss: share of all packets lost, whatever their MCS
    :ivar mute: robots whose packets are not heard after they were met
    :ivar got: by receiver and topic the numbers of the messages that came, and when, s
    """

    snrs_db: dict[int, float]
    loss: float = 0.0
    mode: SealMode = "none"
    seed: int = 1
    mute: set[int] = field(default_factory=set)
    now: float = 0.0

    def __post_init__(self) -> None:
        self.rng = random.Random(self.seed)
        self.sender = Hearing(1, TOPICS, mode=self.mode, any_length=True)
        self.others = {robot: Hearing(robot, mode=self.mode, any_length=True) for robot in self.snrs_db}
        self.got: defaultdict[tuple[int, int], list[tuple[int, float]]] = defaultdict(list)
        self.made: dict[int, int] = dict.fromkeys(LENGTHS, 0)
        self.invariant = PacketsEnd([self.sender, *self.others.values()])
        self._under_way: list[tuple[float, int, Robot, AirPacket]] = []
        self._order = count()
        self._seen = dict.fromkeys(self.others, 0)
        self.free_at, self._steps = 0.0, 0

    @property
    def sent(self) -> list[SentPacket]:
        return [event for event in self.sender.events if isinstance(event, SentPacket)]

    def offer(self, topic: int) -> None:
        payload = self.made[topic].to_bytes(4, "big").ljust(LENGTHS[topic], b".")
        self.made[topic] += 1
        self.sender.end.messages.submit(topic, payload, self.now)

    def run(self, seconds: float, hz: Mapping[int, float], until: Callable[[], bool] = lambda: False) -> None:
        """So long, or until something is so, while messages of topics come so often."""
        end = self.now + seconds
        due = dict.fromkeys(hz, self.now)
        while self.now < end and not until():
            for topic, at in due.items():
                if at <= self.now:
                    self.offer(topic)
                    due[topic] += 1 / hz[topic]
            self._step()
            self.now += STEP_S

    def _step(self) -> None:
        while self._under_way and self._under_way[0][0] <= self.now:
            _, _, robot, packet = heappop(self._under_way)
            robot.events += robot.end.receive(packet, self.now)
        if self.now >= self.free_at and (packet := self._packet(self.sender)) is not None:
            self.free_at = self.now + TABLE[packet.mcs].airtime_s * (len(packet.data) + 16) / 80
            for robot, snr_db in self.snrs_db.items():
                if self.rng.random() < TABLE[packet.mcs].pdr(snr_db):
                    self._travels(packet, self.free_at, self.others[robot], snr_db)
        for robot, other in self.others.items():
            if (packet := self._packet(other)) is not None and robot not in self.mute:
                self._travels(packet, self.now + 0.003, self.sender, 20.0)
            other.events += other.end.handle_timeout(self.now)
            for event in other.events[self._seen[robot] :]:
                if isinstance(event, Delivered):
                    number = int.from_bytes(event.payload[:4], "big")
                    self.got[robot, event.topic_id].append((number, self.now))
            self._seen[robot] = len(other.events)
        self.sender.events += self.sender.end.handle_timeout(self.now)
        self._steps += 1
        if not self._steps % 8:
            self.invariant.step()

    def _packet(self, robot: Robot) -> SentPacket | None:
        if robot.end.pace.out_of_credit:
            robot.end.pace.credit()
        return robot.end.next_packet(self.now)

    def _travels(self, packet: SentPacket, at: float, to: Robot, snr_db: float) -> None:
        if self.rng.random() >= self.loss:
            measured_db = snr_db + self.rng.gauss(0, 0.5)
            heappush(self._under_way, (at, next(self._order), to, AirPacket(packet.data, snr_db=measured_db)))

    def numbers(self, robot: int, topic: int) -> list[int]:
        return [number for number, _ in self.got[robot, topic]]

    def longest_s(self, robot: int, topic: int, since: float) -> float:
        """Longest time between two messages of a topic at a robot."""
        times = [since, *(at for _, at in self.got[robot, topic] if at > since), self.now]
        return max(later - before for before, later in pairwise(times))


FULL = {ODOM: 35.0, SCAN: 5.0, STATE: 1.0}
"""Messages/s that fill the air at the slow rate, and not at the fast one."""


def test_the_near_one_gets_fast_packets_and_the_far_one_its_share_of_slow_ones() -> None:
    pair = Field({2: 30.0, 3: 3.0})
    pair.run(10.0, FULL)
    new = [packet for packet in pair.sent if packet.kind == "new" and packet.packet.entries]
    fast, slow = (sum(packet.mcs == mcs for packet in new) for mcs in (2, 0))
    assert fast > len(new) / 3
    assert slow > len(new) / 10
    for topic in FULL:
        assert len(pair.got[2, topic]) >= len(pair.got[3, topic]) > pair.made[topic] / 8, topic


def test_a_message_that_was_too_fast_for_the_far_one_comes_when_the_air_is_free() -> None:
    pair = Field({2: 30.0, 3: 3.0})
    pair.run(5.0, {ODOM: 10.0})
    for topic in (ODOM, SCAN, STATE, ODOM):
        pair.offer(topic)
        before, newest = len(pair.sent), pair.made[topic] - 1
        pair.run(3.0, {}, until=lambda: all(newest in pair.numbers(robot, topic) for robot in (2, 3)))  # noqa: B023
        assert all(pair.numbers(robot, topic)[-1] == newest for robot in (2, 3))
        ways = [(packet.kind, packet.mcs) for packet in pair.sent[before:] if packet.kind in {"new", "repair"}]
        half = len(ways) // 2
        assert ways == [("new", 2)] * half + [("repair", 0)] * half
    for way in pair.got.values():
        assert [number for number, _ in way] == sorted({number for number, _ in way})


def test_what_was_not_for_a_robot_does_not_count_as_lost() -> None:
    pair = Field({2: 30.0, 3: 8.0})
    pair.run(10.0, FULL)
    rate, peers = pair.sender.end._sending._rate, pair.sender.end.window.peers
    assert rate is not None
    assert rate.chosen(pair.now)[3] == 1
    assert peers.all[3].loss < 0.1
    late = pair.sent[len(pair.sent) // 2 :]
    repairs = [packet.packet.repair for packet in late if packet.kind == "repair"]
    combined = sum(repair is not None and repair.mask != 1 for repair in repairs)
    assert combined <= len(late) / 20


def test_reliable_messages_among_fast_packets_wait_for_none_of_these() -> None:
    pair = Field({2: 30.0, 3: 3.0})
    pair.run(3.0, FULL)
    for _ in range(20):
        pair.offer(EVENTS)
        submitted, wanted = pair.now, pair.made[EVENTS] - 1
        pair.run(2.0, FULL, until=lambda: all(wanted in pair.numbers(robot, EVENTS) for robot in (2, 3)))  # noqa: B023
        assert pair.now - submitted < 0.3
    packets = [packet for packet in pair.sent if any(entry.topic_id == EVENTS for entry in packet.packet.entries)]
    assert {packet.mcs for packet in packets if packet.kind == "new"} <= {0, 1}
    assert any(isinstance(entry, LeftOut) for packet in packets for entry in packet.packet.body)


@example(snrs_db=[3.0 * robot for robot in range(1, 11)], loss=0.05, mode="encrypt", seed=1)
@settings(max_examples=5, deadline=None)
@given(
    snrs_db=st.lists(st.floats(2.0, 30.0), min_size=2, max_size=5),
    loss=st.sampled_from((0.0, 0.2)),
    mode=st.sampled_from(("none", "sign", "encrypt")),
    seed=st.integers(0, 1000),
)
def test_nobody_starves_and_what_is_reliable_reaches_all(
    snrs_db: list[float], loss: float, mode: SealMode, seed: int
) -> None:
    many = Field(dict(enumerate(snrs_db, 2)), loss, mode, seed)
    many.run(3.0, FULL)
    since = many.now
    many.run(5.0, {**FULL, EVENTS: 2.0})
    for robot in many.snrs_db:
        for topic in FULL:
            assert many.longest_s(robot, topic, since) < 4.0, (robot, topic)
    many.run(20.0, {}, until=lambda: all(len(many.got[robot, EVENTS]) == many.made[EVENTS] for robot in many.snrs_db))
    for robot in many.snrs_db:
        assert many.numbers(robot, EVENTS) == list(range(many.made[EVENTS]))
        for topic in FULL:
            assert many.numbers(robot, topic) == sorted(set(many.numbers(robot, topic)))


def test_a_robot_of_an_older_program_is_sent_nothing_faster_than_it_hears(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Inbox, "left_out", lambda *_: None)
    three = Field({2: 30.0, 3: 3.0, 4: 10.0}, loss=0.1)
    hellos: Any = three.others[3].end._sending.hellos
    hellos._capabilities &= ~READS_LEFT_OUT
    three.run(5.0, {**FULL, EVENTS: 2.0})
    assert {packet.mcs for packet in three.sent[-20:] if packet.kind == "new"} == {0}
    events = three.made[EVENTS]
    three.run(20.0, {}, until=lambda: all(len(three.got[robot, EVENTS]) == events for robot in three.snrs_db))
    for robot in three.snrs_db:
        assert three.numbers(robot, EVENTS) == list(range(events))


@pytest.mark.parametrize("snrs_db", [{2: 30.0}, {2: 3.0}, {2: 20.0, 3: 20.0}])
def test_where_all_hear_alike_packets_are_what_they_were(
    snrs_db: dict[int, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    one = Field(dict(snrs_db), loss=0.1)
    one.run(10.0, {**FULL, EVENTS: 2.0})
    monkeypatch.setattr(Audiences, "of", lambda _, __: ())
    other = Field(dict(snrs_db), loss=0.1)
    other.run(10.0, {**FULL, EVENTS: 2.0})
    assert [(packet.data, packet.mcs) for packet in one.sent] == [(packet.data, packet.mcs) for packet in other.sent]


@pytest.mark.parametrize("robot", [1, 2, 3])
def test_a_robot_that_starts_again_gets_what_is_new(robot: int) -> None:
    pair = Field({2: 30.0, 3: 3.0}, loss=0.1, mode="encrypt")
    pair.run(5.0, {**FULL, EVENTS: 2.0})
    (pair.sender if robot == 1 else pair.others[robot]).start()
    since = pair.now
    pair.run(10.0, {**FULL, EVENTS: 2.0})
    for receiver in (2, 3):
        for topic in FULL:
            assert pair.longest_s(receiver, topic, since + 2.0) < 3.0, (receiver, topic)
    pair.run(20.0, {}, until=lambda: all(pair.numbers(r, EVENTS)[-1] == pair.made[EVENTS] - 1 for r in (2, 3)))
    assert all(pair.numbers(receiver, EVENTS)[-1] == pair.made[EVENTS] - 1 for receiver in (2, 3))


def test_a_robot_that_stops_reporting_slows_nobody_down_for_long() -> None:
    pair = Field({2: 30.0, 3: 3.0})
    pair.run(3.0, FULL)
    pair.mute.add(3)
    since, sent = pair.now, len(pair.sent)
    pair.run(9.0, FULL)
    assert pair.longest_s(2, ODOM, since) < 0.2
    assert pair.longest_s(3, ODOM, since) < 1.0, "it is sent to all the same"
    pair.run(5.0, FULL)
    assert {packet.mcs for packet in pair.sent[-20:] if packet.kind == "new"} == {2}, "it is gone"
    assert len(pair.sent) > sent


def test_a_robot_that_comes_nearer_or_goes_away_is_served_as_it_hears() -> None:
    pair = Field({2: 30.0, 3: 3.0})
    pair.run(5.0, FULL)
    for snr_db in (30.0, 3.0, 9.0):
        pair.snrs_db[3] = snr_db
        pair.run(2.0, FULL)
        since = pair.now
        pair.run(4.0, FULL)
        assert pair.longest_s(2, ODOM, since) < 0.2
        assert pair.longest_s(3, ODOM, since) < 0.5
        assert pair.longest_s(3, SCAN, since) < 2.0


def test_packets_left_out_are_not_waited_for() -> None:
    robot, other = Hearing(1, TOPICS), Hearing(2)
    for number in range(80):
        robot.end.messages.submit(EVENTS, bytes(50), number * 0.1)
        while (data := robot.slot(number * 0.1)) is not None:
            answer = other.receive(data, number * 0.1)
            del answer
        if (data := other.slot(number * 0.1)) is not None:
            robot.receive(data, number * 0.1)
    inbox: Inbox = other.end.neighbours.all[1].inbox
    newest = inbox.newest
    inbox.heard(newest + 40, 9.0)
    assert inbox.order.wanted == newest + 1
    inbox.left_out(LeftOut(newest + 40 & 0xFFFF, (1 << 10) - 1, settled=False))
    assert inbox.order.wanted == newest + 1, "others are missing still"
    inbox.left_out(LeftOut(newest + 40 & 0xFFFF, (1 << 40) - 1, settled=False))
    assert inbox.order.wanted == newest + 41
    inbox.heard(newest + 140, 9.1)
    inbox.left_out(LeftOut(newest + 140 & 0xFFFF, 0, settled=True))
    assert inbox.order.wanted == newest + 77


@pytest.mark.parametrize(("length", "packets"), [(20, 1), (200, 4)])
def test_a_message_counts_as_often_as_all_its_packets_come(length: int, packets: int) -> None:
    field = Field({2: 30.0, 3: 7.0})
    field.run(3.0, {ODOM: 10.0})
    audiences = field.sender.end._sending._audiences
    assert audiences is not None
    *_, to_all = audiences.of(field.now)
    topic, message = audiences._topics[ODOM], Message(0, ODOM, bytes(length), 1, field.now, 1.0)

    def worth(share: float) -> float:
        return audiences.value(topic, message, to_all._replace(hears={2: 1.0, 3: share}), 0)

    assert worth(0.5) - worth(0.0) == pytest.approx(0.5**packets * (worth(1.0) - worth(0.0)))
    assert worth(1.0) > worth(0.0) > 0
