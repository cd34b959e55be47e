"""For whom the next packet is, where robots hear at different rates.

A packet for all is sent as the weakest robot needs it, so one far robot would slow down everybody. Where the newest
message of a topic alone counts, the others need not wait for the far one: message and MCS are chosen together, by what
they make younger per airtime, summed over the robots that hear this MCS, as often as these do. The far one's age grows
until it weighs more than theirs, so nobody starves; and what it lacks of the newest message of a topic is sent to it
when the air is free.

Everything else is sent to all: what is delivered in order, kept, or speaks of several instances, and long messages.

Invariants: a message that has begun goes on for those for whom it began; where all robots have the same MCS, or there
is only one, nothing is chosen here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import NamedTuple

from gr_ros2.core.tuning import Tuning
from gr_ros2.link.rate import RateController
from gr_ros2.link.v1.message import Message
from gr_ros2.link.v1.peers import Peers
from gr_ros2.link.v1.sent_packets import Sent, SentPackets
from gr_ros2.link.v1.sent_topics import Late, SentTopic, SentTopics
from gr_ros2.settings.config import NOBODY
from gr_ros2.wire.v1 import BROADCAST

NEVER_S = 1e6
"""Age in s of a topic of which nothing was sent to a robot: it goes before all others."""
_REACH = 160
"""Packets over which it is taken: what was before has a part of .006."""
_REMEMBERED = 1024
"""Packets of which it is known for whom they were."""
_NOTHING: dict[int, float] = {}


class Audience(NamedTuple):
    """Those who hear an MCS.

    :param airtime_s: s that the longest packet takes with it
    :param robots: None for all
    :param hears: share of such packets that each robot is expected to hear
    """

    mcs: int
    airtime_s: float
    robots: frozenset[int] | None
    hears: dict[int, float]


class Audiences:
    """What each robot lacks, and the packets that it cannot hear.

    :param topics: what is sent
    :param reads: whether a robot reads which packets are left out; where one does not, as older programs do not, every
        packet is for all
    :param room: bytes of the longest body
    :param short: bytes of the longest message that is not sent to all in any case
    """

    def __init__(
        self,
        rate: RateController,
        peers: Peers,
        packets: SentPackets,
        topics: SentTopics,
        *,
        reads: Callable[[int], bool],
        room: int,
        short: int,
        tuning: Tuning,
    ) -> None:
        self._tuning = tuning
        self._rate, self._peers, self._packets, self._topics = rate, peers, packets, topics
        self._reads, self._room, self._short = reads, room, short
        self._robots: frozenset[int] = frozenset()
        self._got: dict[int, dict[int, float]] = {}
        """By topic: when the newest message was submitted that each of those got that are behind, s."""
        self._lost: dict[int, dict[int, float]] = {}
        """By number of a packet: with which probability each robot does not hear it that it was not for."""

    def of(self, now: float) -> tuple[Audience, ...]:
        """Those for whom the next packet may be, the fastest first; () where every packet suits all."""
        if len(self._peers.all) < 2:
            return ()
        chosen = self._rate.chosen(now)
        levels = sorted(set(chosen.values()), reverse=True)
        if len(levels) < 2 or not all(map(self._reads, self._peers.all)):
            return ()
        self._got = {topic_id: self._newest(topic) for topic_id, topic in self._topics.items() if topic.behind}
        table = self._rate.mcs_table
        self._robots = frozenset(chosen)
        return tuple(
            Audience(
                level,
                table[level].airtime_s,
                None if level == levels[-1] else frozenset(robot for robot, mcs in chosen.items() if mcs >= level),
                {robot: 1 - self._rate.lost(robot, level, now) for robot in chosen},
            )
            for level in levels
        )

    def level(self, message: Message, audiences: tuple[Audience, ...]) -> Audience:
        """With whom a message that has begun goes on: as fast as those hear for whom it began."""
        some = None if message.robots is None else message.robots & self._robots
        among = (one for one in audiences if one.robots is None or (some is not None and some <= one.robots))
        return next(among)

    def may_begin(self, topic: SentTopic, message: Message, audience: Audience) -> bool:
        """Whether a message may begin in a packet for some, who are among those for whom it is."""
        if audience.robots is None:
            return True
        if topic.in_order or topic.kept or topic.instances is not None or message.repeat:
            return False
        parts = topic.queue.policy == "latest" and len(message.payload) <= self._short
        return parts and bool(self._for(message) & audience.robots)

    def value(
        self, topic: SentTopic, message: Message, audience: Audience, cost: int, before: float | None = None
    ) -> float:
        """The value of a message per byte sent, see ``freshness``: the sum over the robots that get it, with the
        probability that all the rest of it comes.

        :param cost: bytes that it takes in addition to its payload
        :param before: when the message before it was submitted, s, where that is in the same packet
        """
        robots = self._for(message)
        if (some := message.robots if message.started else audience.robots) is not None:
            robots &= some
        got, total = self._got.get(message.topic_id, {}), 0.0
        size = message.remaining + cost
        packets = -(-size // self._room)
        for robot in robots or (NOBODY,):
            newest = got.get(robot, topic.newest) if before is None else before
            younger = min(message.submitted - newest, NEVER_S)
            total += younger * younger * audience.hears.get(robot, 1.0) ** packets
        return message.weight * total / size

    def _for(self, message: Message) -> frozenset[int]:
        """The robots that are known for which a message is."""
        return self._robots if message.dst_id == BROADCAST else self._robots & {message.dst_id}

    def _newest(self, topic: SentTopic) -> dict[int, float]:
        """When the newest message of a topic was submitted that each of those got that did not get the last one at
        first, s."""
        peers, lates = self._peers.all, [(late.submitted, self._open(late)) for late in topic.late]
        return {
            robot: max([before, *[submitted for submitted, bits in lates if not bits & peers[robot].bit]])
            for robot, before in topic.behind.items()
            if robot in peers
        }

    def _open(self, late: Late) -> int:
        """The bits of those who do not hear all packets of a message."""
        found, records = 0, self._packets.records
        for number in late.numbers:
            if (record := records.get(number)) is not None:
                found |= record.skipped
        return found

    def left(self, topic: SentTopic, message: Message) -> None:
        """A message is about to have left whole."""
        others = frozenset[int]() if message.robots is None else self._for(message) - message.robots
        got = self._newest(topic)
        topic.behind = {robot: got.get(robot, topic.newest) for robot in others}
        kept = [late for late in topic.late if others and late.lifetime.completes and self._open(late)]
        for late in topic.late:
            if late not in kept:
                late.lifetime.completes = False
                late.lifetime.end()
        topic.late = [*kept, Late(message.submitted, message.numbers, message.lifetime)] if others else []

    def due(self, now: float) -> Sent | None:
        """A packet for those for whom it was sent too fast, of the topic for which it is worth most."""
        best, due = 0.0, None
        for topic in self._topics.named():
            if not topic.late:
                continue
            for late in topic.late:  # one that was begun is completed, as others are
                if now < late.lifetime.expires and (open_to := self._open(late)):
                    worth, record = self._worth(topic, late, open_to)
                    if worth > best:
                        best, due = worth, record
                    if worth:
                        break
        return due

    def _worth(self, topic: SentTopic, late: Late, open_to: int) -> tuple[float, Sent]:
        """The value per byte of the rest of a message to those who lack it, and its first packet that they lack."""
        peers = self._peers.all
        lacking = [robot for robot in topic.behind if robot in peers and peers[robot].bit & open_to]
        records = [self._packets.records.get(number) for number in late.numbers]
        missing = [record for record in records if record is not None and record.skipped]
        younger = sum(min(late.submitted - topic.behind[robot], NEVER_S) ** 2 for robot in lacking)
        size = sum(len(record.body) for record in missing)
        return topic.weight * younger / size, missing[0]

    def airtime_s(self, robots: Iterable[int], now: float) -> float:
        """s that the longest packet takes as these robots hear it."""
        chosen = self._rate.chosen(now)
        return self._rate.mcs_table[min((chosen.get(robot, 0) for robot in robots), default=0)].airtime_s

    def skipped(self, robots: frozenset[int] | None) -> int:
        """The bits of those who do not hear a packet for some."""
        return 0 if robots is None else self._peers.bits(self._robots - robots)

    def sent(self, robots: frozenset[int] | None, mcs: int, now: float) -> None:
        """A source packet has left."""
        if robots is None and not self._lost:
            return
        number = self._packets.newest
        reached = self._robots if robots is None else robots
        self._lost[number] = {robot: self._rate.lost(robot, mcs, now) for robot in self._robots - reached}
        if len(self._lost) > _REMEMBERED:
            self._lost = {n: lost for n, lost in self._lost.items() if n > number - _REMEMBERED // 2}
            if not any(self._lost.values()):
                self._lost = {}

    def not_for(self, robot: int, number: int) -> float:
        """Share of the newest packets up to a number that a robot is expected to have missed, as they were not for it:
        smoothed as in its reports."""
        share = 0.0
        if self._lost:
            for one in range(number - _REACH + 1, number + 1):
                share += (self._lost.get(one, _NOTHING).get(robot, 0.0) - share) * self._tuning.report_smoothing
        return share
