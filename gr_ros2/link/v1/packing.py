"""What of the waiting messages goes into the next packet.

*Order.* Messages of class latency go first, then default, then bulk. Within a class, messages of more than
``long_packets`` go last. Of the others the message with the largest value per byte sent goes first, ``weight * g^2 /
c`` (see ``freshness``). Every ``turn_every``-th packet begins with the topic whose last turn is longest ago, so that no
topic starves.

*Ages.* A message that has waited for more than one part in ``age_part`` of the time for which it is of use is followed
by its age (``Waited``), behind all messages of the packet. So who hears it, and who gets it over others, counts from
when it was made.

*Robots that hear at different rates.* Of all pairs of a message and an MCS the one with the largest value per airtime
leads, see ``audiences``; what goes along in its packet is for the same robots.

*Fragments.* A message that fits goes whole. A fragment that is not the last one fills its packet. Its size follows from
the free bytes of the packet; it is not fixed beforehand.

Invariant: the messages of a topic begin one after the other, each after the one before has left whole.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from heapq import heapify, heappop, heappush
from math import inf

from gr_ros2.core.tuning import Tuning
from gr_ros2.link.events import SentEntry
from gr_ros2.link.key import Key
from gr_ros2.link.stats import SenderStats
from gr_ros2.link.v1.audiences import Audience, Audiences
from gr_ros2.link.v1.freshness import RANK, Turns, value
from gr_ros2.link.v1.lifetime import Lifetime
from gr_ros2.link.v1.message import Message
from gr_ros2.link.v1.order import ALL
from gr_ros2.link.v1.sent_topics import ON_AIR, RELAYED_TABLES, SentTopics
from gr_ros2.wire import QOS_BULK, QOS_DEFAULT, QOS_LATENCY
from gr_ros2.wire.ages import AGE_STEP_S, age_code
from gr_ros2.wire.control import WAITED_LEN, Waited
from gr_ros2.wire.v1 import TABLE_TOPIC, EntryV1, Part, fit

ENTRY = 3
"""Bytes that an entry takes beside its payload, at least."""


@dataclass(slots=True)
class Filling:
    """The content of a source packet."""

    parts: list[EntryV1]
    sent: tuple[SentEntry, ...]
    lifetimes: tuple[Lifetime, ...]
    qos: int
    used: int
    since: float
    """When the first of its messages that no ``max_rate`` holds back was submitted, s; infinite if there is none."""
    robots: frozenset[int] | None
    """Those for whom it is; None for all."""
    left: list[Message]
    """The messages that leave whole with it."""


class Packing:
    """The choice of what goes into a packet.

    :param boot: boot number of this start, for keys
    :param room: bytes of the longest body
    :param left: called with a message that has left whole, before its lifetime may end with the next one
    :param shares: whether others send on the same channel: a turn comes seldom then, and long messages take the room
        that others leave in every packet
    :param slow: tells whether they come so seldom that messages do not wait for rows of other topics
    :ivar turns: whose turn it is
    """

    def __init__(
        self,
        topics: SentTopics,
        stats: SenderStats,
        left: Callable[[Message, float], None],
        *,
        boot: int,
        room: int,
        tuning: Tuning,
        shares: bool = False,
        slow: Callable[[], bool] = lambda: False,
    ) -> None:
        self._tuning = tuning
        self.turns = Turns(tuning)
        self._audience: Audience | None = None
        """For whom the packet is that is being filled; None for all."""
        self._topics, self._stats, self._left = topics, stats, left
        self._boot = boot
        self._shares, self._slow = shares, slow
        self.short = (1 if shares else self._tuning.long_packets) * room
        """Bytes of a message above which others go before it."""
        self._open: dict[int, Sequence[Message]] = {}
        """Messages that may continue or start now, by topic."""
        self._holder = -1

    def fill(
        self, number: int, room: int, now: float, *, spare: bool = False, audiences: Audiences | None = None
    ) -> Filling | None:
        """Take what goes into the next source packet.

        :param number: number of that packet
        :param room: bytes that its body may have
        :param spare: nothing else needs the packet
        :param audiences: chooses for whom the packet is, where robots hear at different rates; None where nobody does
        :return: None if nothing may be sent
        """
        self._open = {}
        if self._shares and self._slow():
            self._arrange_rows()
        for topic_id, topic in self._topics.items():
            if topic.queue and (ready := topic.queue.open(now)):
                self._open[topic_id] = ready
        if not self._open:
            return None
        levels = () if audiences is None else audiences.of(now)
        heap = self._chosen(audiences, levels) if audiences is not None and levels else self._heap()
        if len(heap) == 1 and not spare and heap[0][2] == TABLE_TOPIC and self.fills:
            return None
        picks: list[tuple[Message, int, int]] = []
        used, ages = 0, b""
        while heap and used < room:
            _, _, topic_id, position = heappop(heap)
            queue = self._open[topic_id]
            message = queue[position]
            remaining, back = len(message.payload) - message.offset, message.back(number)
            told = ages
            if age := self._age(message, now):
                told = ages.ljust(len(picks), b"\0") + bytes((age,))
            free = room - used - (_size(told) if told else 0)
            taken, size = fit(free, remaining, back, message.offset)
            if taken < 0 or not (taken == remaining or self._may_cut(message, taken, used, room)):
                continue
            picks.append((message, taken, back))
            used, ages = used + size, told
            if taken == remaining and position + 1 < len(queue):
                following, topic = queue[position + 1], self._topics[topic_id]
                before = topic.newest if following.repeat else message.submitted
                if audiences is None or self._audience is None:
                    worth = value(following, before, ENTRY)
                elif audiences.may_begin(topic, following, self._audience):
                    worth = audiences.value(topic, following, self._audience, ENTRY, before)
                else:
                    continue
                heappush(heap, (self._rank(following), -worth, topic_id, position + 1))
        if not picks:
            return None
        return self._take(picks, number, used, ages, now, audiences=audiences)

    def _may_cut(self, message: Message, taken: int, used: int, room: int) -> bool:
        """Whether a fragment of this many bytes is worth its header. A message that fits one packet is not cut."""
        if not used or message.qos == QOS_LATENCY:
            return True
        return taken >= room // self._tuning.fragment_part and (message.started or message.remaining > room)

    def _age(self, message: Message, now: float) -> int:
        """The code of the age that is told of a message which may begin in this packet; 0 where it is not told."""
        if message.index:
            return 0
        waited_s = now - (made := message.made)
        if waited_s <= AGE_STEP_S:
            return 0
        limit_s = min(self._topics[message.topic_id].limit_s, message.submitted + message.lifespan_s - made)
        return age_code(waited_s) if waited_s > limit_s / self._tuning.age_part else 0

    def next_timeout(self, now: float) -> float:
        """When ``fill`` may have something, s; inf if nothing waits. What ``fills`` does not count."""
        soonest, fills = inf, self.fills
        for topic_id, topic in self._topics.items():
            if topic.queue and not (fills and topic_id == TABLE_TOPIC):
                opens = topic.queue.opens(now)
                soonest = min(soonest, opens if opens < inf else now)
        return soonest

    @property
    def fills(self) -> bool:
        """Whether rows of the table wait for room that nothing else needs."""
        table = self._topics.get(TABLE_TOPIC)
        return table is not None and len(table.queue) > 0 and table.queue[0].qos == QOS_BULK

    @property
    def awaits_row(self) -> bool:
        """Whether the next packet brings a row of the table that messages wait for, where turns are rare."""
        if not (self._shares and self._slow()) or (table := self._topics.get(TABLE_TOPIC)) is None:
            return False
        return any(row.started or not self._later(row) for row in table.queue)

    @property
    def urgent(self) -> bool:
        """Whether a message of class latency waits. The table of topics does not count: it follows a hello."""
        return any(topic.queue and topic.queue[0].qos == QOS_LATENCY for topic in self._topics.named())

    def _arrange_rows(self) -> None:
        """Let a row of a topic whose messages wait go before all messages, and the others into what these leave."""
        table = self._topics.get(TABLE_TOPIC)
        if table is None or not table.queue:
            return
        started = [row for row in table.queue if row.started]
        rows = started + sorted((row for row in table.queue if not row.started), key=self._later)
        for place, row in enumerate(rows):
            again = QOS_LATENCY if row.left_at == inf else QOS_DEFAULT
            row.qos = QOS_BULK if place or (not row.started and self._later(row)) else again
        table.queue.clear()
        table.queue.extend(rows)

    def _later(self, row: Message) -> bool:
        """Whether no message waits for a row of the table."""
        topic = self._topics.get(row.payload[1])
        return topic is None or not topic.queue

    def _rank(self, message: Message) -> float:
        return RANK[message.qos] + 0.5 * self._is_long(message)

    def _is_long(self, message: Message) -> bool:
        """Whether others go before a message. Without its table, nothing of a robot is of use."""
        return len(message.payload) > self.short and message.topic_id != RELAYED_TABLES

    def _turn(self) -> int:
        """Whose turn it is; the table has none where it fills what others leave, nor where it goes first anyway."""
        table = self._open.get(TABLE_TOPIC)
        without = table is not None and (self.fills or table[0].qos == QOS_LATENCY)
        return self.turns.holder(self._open.keys() - {TABLE_TOPIC} if without else self._open)

    def _heap(self) -> list[tuple[float, float, int, int]]:
        """Topics that may send, the most urgent and most valuable first."""
        self._holder = holder = self._turn()
        self._audience = None
        if len(self._open) == 1:  # nothing to choose
            (only,) = self._open
            return [(0, 0, only, 0)]
        heap: list[tuple[float, float, int, int]] = []
        for topic_id, ready in self._open.items():
            head = ready[0]
            worth = value(head, self._topics[topic_id].newest, ENTRY)
            rank = self._rank(head)
            heap.append((-1 if topic_id == holder else rank, -worth, topic_id, 0))
        heapify(heap)
        return heap

    def _chosen(self, audiences: Audiences, levels: tuple[Audience, ...]) -> list[tuple[float, float, int, int]]:
        """The same for those for whom the packet is worth most per airtime."""
        waiting = self._open
        holder = self._holder = self._turn()
        best: tuple[float, float] = inf, 0.0
        chosen: list[tuple[float, float, int, int]] = []
        for level in levels:
            heap: list[tuple[float, float, int, int]] = []
            for topic_id, ready in waiting.items():
                topic, head = self._topics[topic_id], ready[0]
                if head.started:
                    joins = audiences.level(head, levels) == level
                else:
                    joins = audiences.may_begin(topic, head, level)
                if joins:
                    rank = self._rank(head)
                    worth = audiences.value(topic, head, level, ENTRY)
                    heap.append((-1 if topic_id == holder else rank, -worth, topic_id, 0))
            if heap:
                heapify(heap)
                worth_of_air = heap[0][0], heap[0][1] / level.airtime_s
                if worth_of_air < best:
                    best, chosen, self._audience = worth_of_air, heap, level
        self._open = {topic_id: waiting[topic_id] for _, _, topic_id, _ in chosen}
        return chosen

    def _take(
        self,
        picks: list[tuple[Message, int, int]],
        number: int,
        used: int,
        ages: bytes,
        now: float,
        *,
        audiences: Audiences | None,
    ) -> Filling:
        parts: list[EntryV1] = []
        sent: list[SentEntry] = []
        lifetimes: list[Lifetime] = []
        left: list[Message] = []
        stats, qos, since = self._stats, picks[0][0].qos, inf
        robots = None if self._audience is None else self._audience.robots
        for place, (message, taken, back) in enumerate(picks):
            topic_id, offset, lifetime = message.topic_id, message.offset, message.lifetime
            topic, queue = self._topics[topic_id], self._topics[topic_id].queue
            if not message.index:
                message.begin, message.place, message.robots = number - back, -1 if back else place, robots
                lifetime.chained = topic.coded
                lifetime.expires, lifetime.keys = message.expires, message.keys
                lifetime.topic_id, lifetime.order = topic_id, (message.begin, message.place if not back else ALL)
                lifetime.in_order = topic.in_order or (self._shares and topic_id == TABLE_TOPIC)
                lifetime.long = self._is_long(message)
                lifetime.fresh = not (lifetime.in_order or topic.kept or topic_id > TABLE_TOPIC)
                queue.started(message, now)
            if message.submitted < since and not topic.topic.options.max_rate:
                since = message.submitted
            lifetime.awaited = len(queue) > 1
            if topic.coded or message.robots is not None:
                message.numbers.append(number)
            payload = message.take(taken)
            last = message.offset == len(message.payload)
            whole = last and not message.begins
            parts.append(Part(ON_AIR.get(topic_id, topic_id), payload, back, offset, whole, message.coded))
            named = (number, place) if message.place < 0 else (message.begin, message.place)
            of, key = message.carried or (topic_id, Key(self._boot, *named))
            total = message.index if whole else 0
            sent.append(SentEntry(message.serial, of, key, message.index - 1, total, message.repeat))
            lifetimes.append(lifetime)
            if RANK[message.qos] < RANK[qos]:
                qos = message.qos
            stats.payload_bytes += taken
            if last:
                lifetime.left, message.left_at = True, now
                queue.popleft()
                if audiences is not None and (topic.behind or message.robots is not None):
                    audiences.left(topic, message)
                if message.submitted > topic.newest and not (queue and queue[0].repeat):
                    topic.newest = message.submitted  # what is repeated together is worth the same
                stats.sent[of] += not message.repeat
                self._left(message, now)
                left.append(message)
        # On a shared channel a topic that goes along in a packet has had a turn: fresh messages are in every packet.
        self.turns.sent([message.topic_id for message, _, _ in picks] if self._shares else [self._holder])
        stats.entries += len(picks)
        if ages:
            parts.append(Waited(ages))
            used += WAITED_LEN + len(ages)
        return Filling(parts, tuple(sent), tuple(lifetimes), qos, used, since, robots, left)


def _size(ages: bytes) -> int:
    """Bytes that ages take behind the last message, which then needs its length."""
    return WAITED_LEN + len(ages) + 1
