"""What waits to be sent, and what goes into the next packet.

*Order.* Messages of class latency go first, then default, then bulk. Within a class, the message with the largest value
per byte sent goes first, ``weight * g^2 / c`` (see ``link.freshness``). Every ``TURN``-th packet begins with the topic
whose last turn is longest ago, so that no topic starves.

*Fragments.* A message that fits goes whole. A fragment that is not the last one fills its packet. Its size follows from
the free bytes of the packet; it is not fixed beforehand.

*Lifetime.* The topic decides how long a message is worth repairing. With ``latest``, it is until a newer message has
left whole. With a lifespan, it is until that has passed. Otherwise it is until ``depth`` newer messages have left, or
enough newer ones to fill a repair, and not longer after the next message than a receiver waits for it. Receivers that
report say when they have a message; then only the publishers' depth limits the lifetime.

Invariants: the messages of a topic begin one after the other, each after the one before has left whole; every message
ends in being sent or in a Refused with its row.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from heapq import heapify, heappop, heappush
from math import inf
from zlib import crc32

from gr_ros2.config import QueuePolicy
from gr_ros2.link.airtime import LEAD_S
from gr_ros2.link.events import Accepted, Missed, Refused, SentEntry
from gr_ros2.link.fragment import Outgoing
from gr_ros2.link.freshness import FIRST_AGE_S, LARGE, RANK, Turns, value
from gr_ros2.link.ledger_rows import LedgerRow
from gr_ros2.link.message_codec import MessageCodec
from gr_ros2.link.queues import Dropped, TopicQueue, queue_for
from gr_ros2.link.stats import SenderStats
from gr_ros2.link.v1.endpoint_settings import Settings
from gr_ros2.link.v1.key import Key
from gr_ros2.link.v1.repair import GROUP, Life
from gr_ros2.registry import Registry, Topic
from gr_ros2.setting import AUTO
from gr_ros2.wire import QOS_BULK, QOS_NAMES
from gr_ros2.wire.table import Row as TableRow
from gr_ros2.wire.table import write_table
from gr_ros2.wire.v1 import MAX_MESSAGE, TABLE_TOPIC, Part, fit

SHARE = 3
"""A fragment must fill at least one part in this many of a packet's room: a message in more packets than it needs is
lost with any of them. A message of class latency uses any space that is free."""
TABLE_FIRST = 2
"""Number of packets up to which the table of topics goes before messages."""
SETTLING_S = 1.0
"""s after which a latched message is named in hellos: a receiver that lacks it then has lost it, not just not received
it yet."""
STARTING_S = 2.0
"""s from the start during which the table is repaired even if no receiver reports."""
WORTH = 0.85
"""Part of ``hold_s`` for which a message is repaired after the next one of its topic has left, while nobody reports. A
receiver goes on without it after ``hold_s``; what comes back later than that is of no use."""
REPORTED_DEPTH = 160
"""Newer messages after which a message is not repaired any more where receivers report and the publishers' depth is not
known; but it is repaired for as long as a receiver waits for it (``hold_s``)."""
_ENTRY = 3

Observer = Callable[[Accepted | Refused | Missed], None]


@dataclass(slots=True, eq=False)
class Message(Outgoing):
    """A message to be sent. ``begin``: packet in which it began; ``place``: its place among the entries there."""

    life: Life = field(default_factory=Life)
    begin: int = 0
    place: int = 0
    coded: bool = False


@dataclass(slots=True, eq=False)
class _Kept:
    """A message kept for robots that join late."""

    serial: int
    payload: bytes
    coded: bool
    mark: int
    named: float = inf
    """Time in s from which on hellos name it."""


@dataclass(slots=True)
class Filling:
    """The content of a source packet."""

    parts: list[Part]
    sent: list[SentEntry]
    lives: tuple[Life, ...]
    qos: int
    used: int


class Outbox:
    """The queues of one sender.

    :param topics: topics that it may send; the announced table is made from them
    :param boot: boot number of this start, for keys
    :param room: bytes of the longest body
    """

    def __init__(
        self,
        topics: Registry | None,
        settings: Settings,
        *,
        boot: int,
        room: int,
        codec: MessageCodec | None,
        observer: Observer,
    ) -> None:
        self._settings = settings
        self._topics: dict[int, Topic] = {}
        self._boot = boot
        self._room = room
        self._codec = codec
        self._observe = observer
        self._queues: dict[int, TopicQueue] = {}
        self._depths: dict[int, int] = {}
        self._latched: dict[int, bool] = {}
        """Whether the publishers of a topic keep messages for late joiners."""
        self._lives: dict[int, deque[tuple[Life, int, float]]] = {TABLE_TOPIC: deque()}
        self._packets_of: Counter[int] = Counter()
        """Lifetimes that packets refer to, by topic."""
        self._kept: dict[int, deque[_Kept]] = {}
        self._open: dict[int, Sequence[Outgoing]] = {}
        """Messages that may continue or start now, by topic."""
        self._newest: dict[int, float] = {}
        self._turns = Turns()
        self._holder = -1
        self._serial = 0
        self.stats = SenderStats()
        self._starting_until = inf
        self.reported = False
        """Whether receivers report, so that it is known when a message is over."""
        self._with_deadline: list[TopicQueue] = []
        self._ordered: dict[int, bool] = {}
        self._hidden: set[int] = set()
        """Topics that the table leaves out: services whose server is not there."""
        self.digest = 0
        """CRC-32 of the table; 0 if there is nothing to announce."""
        if topics:
            self.add(topics)

    def add(self, topics: Sequence[Topic]) -> None:
        """Send and announce these topics too."""
        for topic in topics:
            self._topics[topic.topic_id] = topic
            self._queues[topic.topic_id] = TopicQueue(*queue_for(topic.options), topic.options.max_rate)
            self._lives[topic.topic_id] = deque()
        self._hidden |= {topic.topic_id for topic in topics if not topic.is_topic}
        if TABLE_TOPIC not in self._queues:
            self._queues[TABLE_TOPIC] = TopicQueue("latest")
        self._with_deadline = [queue for queue in self._queues.values() if queue.deadline_s]
        self._tabulate()

    def offer(self, topic_id: int, *, offered: bool) -> bool:
        """Announce a service, or no longer.

        :return: whether the table of topics has changed
        """
        if offered:
            self._hidden.discard(topic_id)
        else:
            self._hidden.add(topic_id)
        before = self.digest
        self._tabulate()
        return self.digest != before

    def submit(self, topic_id: int, payload: bytes, now: float, lifespan_s: float = inf) -> None:
        """Take a message. It may be refused, or cause other messages of its topic to be dropped.

        :param lifespan_s: see :class:`gr_ros2.link.fragment.Outgoing`
        """
        topic = self._topics[topic_id]
        serial = self._serial
        self._serial += 1
        self.stats.submitted[topic_id] += 1
        codec = self._codec
        self._observe(
            Accepted(serial, topic_id, payload, now, None if codec is None else codec.canonical(topic_id, payload))
        )
        if codec is not None:
            payload = codec.encode(topic_id, payload)
        if len(payload) > MAX_MESSAGE:
            self._refuse(serial, topic_id, LedgerRow.TOO_LARGE, f"{len(payload)} bytes; at most {MAX_MESSAGE}")
            return
        if self._is_latched(topic):
            kept = self._kept.setdefault(topic_id, deque(maxlen=max(self._depths.get(topic_id, 1), 1)))
            kept.append(_Kept(serial, payload, codec is not None, crc32(payload)))
        qos = QOS_NAMES.index(topic.options.qos)
        weight = topic.options.weight
        self._admit(
            Message(serial, topic_id, payload, qos, now, weight, coded=codec is not None, lifespan_s=lifespan_s)
        )

    def ask(self, topic_id: int, now: float) -> None:
        """Send the kept message of a topic again because a robot lacks it, unless it is waiting already."""
        self._starting_until = min(self._starting_until, now + STARTING_S)
        queue = self._queues.get(topic_id)
        if queue is None or any(message.repeat for message in queue):
            return
        for kept in self._kept.get(topic_id, ()):
            if topic_id == TABLE_TOPIC:
                # Nothing is delivered without the table. A long table does not delay urgent messages.
                qos = 1 if len(kept.payload) <= TABLE_FIRST * self._room else 0
                queue.append(Message(kept.serial, TABLE_TOPIC, kept.payload, qos, now, repeat=True))
            else:
                weight = self._topics[topic_id].options.weight
                again = Message(
                    kept.serial, topic_id, kept.payload, QOS_BULK, now, weight, repeat=True, coded=kept.coded
                )
                self._admit(again)
            self.stats.repeats += 1

    def announce(self, now: float) -> None:
        """Send all kept messages, for robots that cannot ask."""
        for topic_id in self._kept:
            if not self._queues[topic_id]:
                self.ask(topic_id, now)

    def marks(self, now: float) -> list[tuple[int, int]]:
        """What hellos name: (topic id, CRC-32) of the kept messages."""
        return [
            (topic_id, kept.mark)
            for topic_id, messages in self._kept.items()
            if topic_id != TABLE_TOPIC
            for kept in messages
            if now >= kept.named
        ]

    def follow(
        self, topic_id: int, *, reliable: bool, latched: bool, depth: int, lifespan_s: float, period_s: float
    ) -> bool:
        """Take over the QoS of a topic's publishers, where the configuration leaves it open.

        :return: whether the table of topics has changed
        """
        queue = self._queues[topic_id]
        self._depths[topic_id] = depth
        self._latched[topic_id] = latched
        self._ordered[topic_id] = reliable
        queue.change(*queue_for(self._topics[topic_id].options, depth, lifespan_s, period_s))
        self._with_deadline = [queue for queue in self._queues.values() if queue.deadline_s]
        before = self.digest
        self._tabulate()
        return self.digest != before

    def queue(self, topic_id: int) -> tuple[QueuePolicy, float]:
        """Policy and deadline (s, 0 for none) of a topic's queue."""
        queue = self._queues[topic_id]
        return queue.policy, queue.deadline_s

    def reconfigure(self, settings: Settings) -> None:
        """Use other settings from now on."""
        self._settings = settings

    def expire(self, now: float, interval: float) -> None:
        """Drop messages that would arrive too late."""
        for queue in self._with_deadline:
            if queue:
                self._drop(list(queue.expire(now, interval, LEAD_S, self._room - _ENTRY)))

    def fill(self, number: int, room: int, now: float) -> Filling | None:
        """Take what goes into the next source packet.

        :param number: number of that packet
        :param room: bytes that its body may have
        :return: None if nothing may be sent
        """
        if self.idle:
            return None
        heap = self._heap(now)
        picks: list[tuple[Message, int]] = []
        used = 0
        while heap and used < room:
            _, _, topic_id, position = heappop(heap)
            queue = self._open[topic_id]
            message = queue[position]
            assert isinstance(message, Message)
            taken, size = fit(room - used, message.remaining, number - message.begin, message.offset)
            if taken < 0 or not (taken == message.remaining or self._may_cut(message, taken, used, room)):
                continue
            picks.append((message, taken))
            used += size
            if taken == message.remaining and position + 1 < len(queue):
                following = queue[position + 1]
                worth = value(following, message.submitted, _ENTRY)
                heappush(heap, (RANK[following.qos], -worth, topic_id, position + 1))
        if not picks:
            return None
        wait = self._settings.flush_timeout_s
        if wait and room - used >= self._settings.min_fragment + _ENTRY:
            since = min(min(message.submitted, self._queues[message.topic_id].since) for message, _ in picks)
            if now < since + wait:
                return None
        return self._take(picks, number, used, now)

    def next_timeout(self, now: float) -> float | None:
        """When ``fill`` may have something; None if nothing waits."""
        times = [
            max(queue.opens(now) if queue.opens(now) < inf else now, self._flush(queue, now))
            for queue in self._queues.values()
            if queue
        ]
        return min(times) if times else None

    @property
    def urgent(self) -> bool:
        """Whether a message of class latency waits. The table of topics does not count: it follows a hello."""
        return any(queue and queue[0].qos == 1 for topic_id, queue in self._queues.items() if topic_id != TABLE_TOPIC)

    @property
    def idle(self) -> bool:
        """Whether nothing waits."""
        return not any(self._queues.values())

    def queued(self) -> dict[int, int]:
        """Messages that wait or are partly sent, per topic id."""
        return {topic_id: len(queue) for topic_id, queue in self._queues.items() if topic_id != TABLE_TOPIC}

    def room(self, topic_id: int) -> bool:
        """Whether a message of that topic could be submitted without dropping another one."""
        return self._queues[topic_id].room(self.depth(topic_id))

    def _tabulate(self) -> None:
        """Make the table of topics."""
        rows = []
        for topic in self._topics.values():
            if topic.topic_id in self._hidden:
                continue
            options = topic.options
            reliable = options.reliability
            ordered = self._ordered.get(topic.topic_id, True) if reliable == AUTO else reliable == "reliable"
            ordered = ordered and self._queues[topic.topic_id].policy != "latest"
            depth = self._depths.get(topic.topic_id, 0) if options.depth == AUTO else options.depth
            codec = "" if self._codec is None else options.codec
            qos = QOS_NAMES.index(options.qos)
            name, kind, latched = topic.name, topic.type_name, self._is_latched(topic)
            rows.append(TableRow(topic.topic_id, name, kind, qos, ordered, latched, min(depth, 255), codec))
        if not rows and not self.digest:
            return
        table = write_table(rows)
        self.digest = crc32(table)
        self._kept[TABLE_TOPIC] = deque([_Kept(-1, table, False, self.digest)])

    def _is_latched(self, topic: Topic) -> bool:
        """Whether late joiners get the newest messages: as configured, by ROS convention, or as its publishers say."""
        learned = topic.options.durability == AUTO and self._latched.get(topic.topic_id, False)
        return learned or topic.latched

    def _flush(self, queue: TopicQueue, now: float) -> float:
        return queue.since + self._settings.flush_timeout_s if self._settings.flush_timeout_s else now

    def depth(self, topic_id: int) -> int:
        """Number of messages of a topic that may wait, 0 for unbounded."""
        depth = self._topics[topic_id].options.queue_depth
        return self._settings.queue_depth if depth == AUTO else depth

    def _admit(self, message: Message) -> None:
        self._drop(self._queues[message.topic_id].admit(message, self.depth(message.topic_id)))

    def _heap(self, now: float) -> list[tuple[int, float, int, int]]:
        """Topics that may send, the most urgent and most valuable first."""
        self._open = {topic_id: queue.open(now) for topic_id, queue in self._queues.items() if queue}
        heap = []
        for topic_id, queue in self._open.items():
            if queue:
                head = queue[0]
                before = self._newest.get(topic_id, head.submitted - FIRST_AGE_S)
                heap.append((RANK[head.qos], -value(head, before, _ENTRY), topic_id, 0))
        holder = self._holder = self._turns.holder([item[2] for item in heap]) if heap else -1
        if holder >= 0:
            heap = [(-1, item[1], holder, 0) if item[2] == holder and item[0] else item for item in heap]
        heapify(heap)
        return heap

    def _may_cut(self, message: Message, taken: int, used: int, room: int) -> bool:
        """Whether a fragment of this many bytes is worth its header."""
        if not used:
            return True
        if taken < max(self._settings.min_fragment, 0 if message.qos == 1 else room // SHARE):
            return False
        return message.started or message.qos == 1 or message.remaining > LARGE * room

    def _take(self, picks: list[tuple[Message, int]], number: int, used: int, now: float) -> Filling:
        parts: list[Part] = []
        sent: list[SentEntry] = []
        lives: dict[Life, None] = {}
        qos = picks[0][0].qos
        for place, (message, taken) in enumerate(picks):
            topic_id, offset = message.topic_id, message.offset
            queue = self._queues[topic_id]
            if not message.index:
                message.begin, message.place = number, place
                message.life.expires = message.expires
                queue.started(now)
            payload = message.take(taken)
            last = not message.remaining
            begin = message.begin
            parts.append(Part(topic_id, payload, number - begin if offset else 0, offset, last, message.coded))
            key = Key(self._boot, begin, message.place)
            total = message.index if last else 0
            sent.append(SentEntry(message.serial, topic_id, key, message.index - 1, total, message.repeat))
            lives[message.life] = None
            qos = min(qos, message.qos, key=RANK.__getitem__)
            self.stats.payload_bytes += taken
            if last:
                queue.popleft()
                self._left(message, queue, now)
        self._turns.sent(self._holder)
        self.stats.entries += len(picks)
        return Filling(parts, sent, tuple(lives), qos, used)

    def _left(self, message: Message, queue: TopicQueue, now: float) -> None:
        """A message has left whole: older messages that it replaces are over."""
        topic_id = message.topic_id
        self._newest[topic_id] = max(message.submitted, self._newest.get(topic_id, 0.0))
        self.stats.sent[topic_id] += not message.repeat
        lives = self._lives[topic_id]
        most, least_s = self._settings.depth, 0.0
        if queue.policy == "latest":
            most = 1
        elif self.reported:
            most = self._depths.get(topic_id, 0)
            if not most:
                most, least_s = REPORTED_DEPTH, self._settings.hold_s
        elif lives:
            before, _, _ = lives[-1]
            before.expires = min(before.expires, now + WORTH * self._settings.hold_s)
        lives.append((message.life, message.index, now))
        self._packets_of[topic_id] += message.index
        while len(lives) > 1 and (
            (len(lives) > most and now - lives[0][2] >= least_s)
            or (self._packets_of[topic_id] > GROUP and not self.reported)
        ):
            life, count, _ = lives.popleft()
            life.over = True
            self._packets_of[topic_id] -= count
        for kept in self._kept.get(topic_id, ()):
            if kept.payload is message.payload and kept.named == inf:
                kept.named = now + SETTLING_S
        if topic_id == TABLE_TOPIC and not self.reported:
            # Later the table is sent again, and is small; at the start, nothing can be delivered without it.
            message.life.expires = self._starting_until
        elif topic_id in self._kept and not self.reported:
            message.life.expires = min(message.life.expires, now + 2 * (now - message.submitted) + 2.0)

    def _drop(self, dropped: list[Dropped]) -> None:
        for item in dropped:
            item.message.index = max(item.message.index, 1)
            if isinstance(item.message, Message):
                item.message.life.over = True
            if not item.message.repeat:
                self._refuse(item.message.serial, item.message.topic_id, item.row, item.detail)

    def _refuse(self, serial: int, topic_id: int, reason: LedgerRow, detail: str) -> None:
        self.stats.refused[topic_id, reason.value] += 1
        self._observe(Refused(serial, topic_id, reason, detail))
