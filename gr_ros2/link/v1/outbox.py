"""What waits to be sent, and what goes into the next packet.

*Order.* Messages of class latency go first, then default, then bulk. Within a class, messages of more than ``LONG``
packets go last. Of the others the message with the largest value per byte sent goes first, ``weight * g^2 / c`` (see
``freshness``). Every ``TURN``-th packet begins with the topic
whose last turn is longest ago, so that no topic starves.

*Fragments.* A message that fits goes whole. A fragment that is not the last one fills its packet. Its size follows from
the free bytes of the packet; it is not fixed beforehand.

*Lifetime.* The topic decides how long a message is worth repairing. With ``latest``, it is until a newer message has
left whole. With a lifespan, it is until that has passed. Otherwise it is until ``depth`` newer messages have left, or
enough newer ones to fill a repair, and not longer after the next message than a receiver waits for it. Receivers that
report say when they have a message: then a message that is delivered in order is repaired until they have it, and any
other until ``depth`` newer ones have left.

Invariants: the messages of a topic begin one after the other, each after the one before has left whole; every message
ends in being sent or in a Refused with its row.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from heapq import heapify, heappop, heappush
from math import inf
from typing import Any, Protocol
from zlib import crc32

from gr_ros2.core.errors import ConfigError
from gr_ros2.link.airtime import LEAD_S
from gr_ros2.link.events import Accepted, Missed, Refused, SentEntry
from gr_ros2.link.fragment import Outgoing
from gr_ros2.link.ledger_rows import LedgerRow
from gr_ros2.link.message_codec import MessageCodec
from gr_ros2.link.queues import Dropped, TopicQueue, qos_class, queue_for
from gr_ros2.link.stats import SenderStats
from gr_ros2.link.v1.endpoint_settings import Settings
from gr_ros2.link.v1.freshness import FIRST_AGE_S, LARGE, RANK, Turns, value
from gr_ros2.link.v1.key import Key
from gr_ros2.link.v1.repair import GROUP, Lifetime
from gr_ros2.settings.commands import is_command
from gr_ros2.settings.config import QueuePolicy
from gr_ros2.settings.fields import AUTO
from gr_ros2.settings.registry import CALLS_TYPE, NewTopic, Registry, Topic
from gr_ros2.wire import QOS_BULK, QOS_LATENCY
from gr_ros2.wire.table import AnnouncedTopic, write_table
from gr_ros2.wire.v1 import MAX_MESSAGE, TABLE_TOPIC, EntryV1, Part, fit

SHARE = 2
"""A fragment must fill at least one part in this many of a packet's room: a message in more packets than it needs is
lost with any of them. With smaller fragments (3), the scans of ``six-topics-paced`` are 3 % younger without loss, and
16 % older at 20 % loss. A message of class latency uses any space that is free from ``MIN_FRAGMENT`` bytes on."""
MIN_FRAGMENT = 16
LONG = 64
"""A message of more packets goes after all others of its class, into the room that these leave. Odometry at 35 Hz
beside 1 MB is then 1.05 times as old as without it; by value alone 1.4 times, because the last 60 kB go before it."""
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
"""Newer messages after which a message of a best-effort topic is not repaired any more, where receivers report and the
publishers' depth is not known."""
MOST_LIFETIMES = 4096
"""The same for a topic that is delivered in order: a bound on memory. Its receivers wait for the message."""
UNREPORTED_DEPTH = 48
"""Newer messages of the same topic after which a message is not repaired any more, while no robot reports. It applies
to topics without lifespan."""
_ENTRY = 3

Observer = Callable[[Accepted | Refused | Missed], None]


@dataclass(slots=True, eq=False)
class Message(Outgoing):
    """A message to be sent. ``begin``: packet in which it began; ``place``: its place among the entries there."""

    lifetime: Lifetime = field(default_factory=Lifetime)
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
    until: float = inf
    """Time in s until which it is sent again."""


@dataclass(slots=True, eq=False)
class _Line:
    """One topic, or the table of topics.

    :param qos: QoS class of its messages
    :param latched: whether its newest messages are kept for robots that join late, however old they are
    :param depth: of its publishers' history, 0 for unbounded or unknown
    :param ordered: whether all its publishers are reliable
    :param command: whether its messages are commands
    :param hidden: whether the table leaves it out: a service whose server is not there
    :param newest: when the newest of its messages that have left was submitted, s
    :param lifetimes: lifetimes of its messages that have left, and the packets of each
    :param packets: the packets of all of them
    """

    topic: Topic
    queue: TopicQueue
    qos: int
    weight: float
    latched: bool
    hidden: bool = False
    command: bool = False
    depth: int = 0
    ordered: bool = True
    newest: float = -inf
    lifetimes: deque[tuple[Lifetime, int]] = field(default_factory=deque)
    packets: int = 0

    @property
    def kept(self) -> bool:
        """Whether its newest messages are kept for robots that lack them."""
        return self.latched or self.topic.options.keep_s > 0

    @property
    def is_stream(self) -> bool:
        """Whether its messages are useless when newer ones have come, should the computer be too slow for all."""
        return self.topic.is_topic and not self.kept and not self.topic.options.max_rate

    @property
    def kept_depth(self) -> int:
        """How many messages late robots and late subscribers get.

        One, unless the topic's options say otherwise: where the graph does not tell the depth of a map's publisher, an
        earlier map would come out after the newest one.
        """
        depth = self.topic.options.depth
        return 1 if depth == AUTO else depth

    @property
    def in_order(self) -> bool:
        """Whether its messages are delivered in order, each after all earlier ones."""
        wanted = self.topic.options.reliability
        return (self.ordered if wanted == AUTO else wanted == "reliable") and self.queue.policy != "latest"


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


class Owner(Protocol):
    """What an outbox tells its endpoint."""

    def submitted(self, topic_id: int, now: float) -> bool:
        """A message of a topic has come; returns whether the computer is too slow for what comes."""

    def topics_changed(self, *, added: bool = False, asked: bool = False) -> None:
        """The table of topics has changed.

        :param added: by further topics
        :param asked: the table has to be sent, although no robot asks
        """


class Outbox:
    """The messages of one sender.

    :param topics: topics that it may send; the announced table is made from them
    :param owner: is told what comes and changes
    :param boot: boot number of this start, for keys
    :param room: bytes of the longest body
    """

    def __init__(
        self,
        topics: Registry | None,
        settings: Settings,
        owner: Owner,
        *,
        boot: int,
        room: int,
        codec: MessageCodec | None,
        observer: Observer | None,
    ) -> None:
        self.topics = topics
        """What it sends."""
        self._settings = settings
        self._owner = owner
        self._boot = boot
        self._room = room
        self._codec = codec
        self._observer = observer
        self._lines: dict[int, _Line] = {}
        self._kept: dict[int, deque[_Kept]] = {}
        self._open: dict[int, Sequence[Outgoing]] = {}
        """Messages that may continue or start now, by topic."""
        self._turns = Turns()
        self._holder = -1
        self._serial = 0
        self.stats = SenderStats()
        self._starting_until = inf
        self.reported = False
        """Whether receivers report, so that it is known when a message is over."""
        self.deadlines: list[TopicQueue] = []
        """The queues whose messages may be too late."""
        self.digest = 0
        """CRC-32 of the table; 0 if there is nothing to announce."""
        if topics:
            self._add(topics)

    def add(self, rows: Sequence[NewTopic]) -> Registry:
        """See :class:`gr_ros2.link.endpoint.MessageSide`. The robots that hear this one learn of them from the next
        hello."""
        together = (Registry.empty() if self.topics is None else self.topics).extended(rows)
        topics = together[-len(rows) :] if rows else ()
        if self._codec is not None:
            for topic in topics:
                self._codec.add(topic)
        self.topics = together
        self._add(topics)
        self._owner.topics_changed(added=True)
        return together

    def _add(self, topics: Sequence[Topic]) -> None:
        """Queue and announce these topics too."""
        for topic in topics:
            command = is_command(topic.name, topic.type_name, self._settings.commands)
            queue = TopicQueue(*queue_for(topic.options, command=command), topic.options.max_rate)
            self._lines[topic.topic_id] = _line(topic, queue, command=command)
        if TABLE_TOPIC not in self._lines:
            self._lines[TABLE_TOPIC] = _line(Topic(TABLE_TOPIC, "", ""), TopicQueue("latest"))
        self._find_deadlines()
        self._tabulate()

    def learn(self, type_name: str, definitions: Mapping[str, Any]) -> None:
        """See :class:`gr_ros2.link.endpoint.MessageSide`. The robots that hear this one are told."""
        if self._codec is None:
            return
        self._codec.learn(type_name, definitions)
        if self._tabulate():
            self._owner.topics_changed(asked=True)

    def offer(self, topic_id: int, *, offered: bool) -> None:
        """See :class:`gr_ros2.link.endpoint.MessageSide`."""
        self._lines[topic_id].hidden = not offered
        if self._tabulate():
            self._owner.topics_changed(asked=True)

    def missed(self, topic_id: int, total: int) -> None:
        """See :class:`gr_ros2.link.endpoint.MessageSide`."""
        new = total - self.stats.missed[topic_id]
        if new > 0:
            self.stats.missed[topic_id] = total
            if self._observer is not None:
                self._observer(Missed(topic_id, new))

    def submit(self, topic_id: int, payload: bytes, now: float, lifespan_s: float = inf) -> None:
        """See :class:`gr_ros2.link.endpoint.MessageSide`."""
        line = self._lines.get(topic_id)
        if line is None or topic_id == TABLE_TOPIC:
            raise ConfigError(f"topic id {topic_id} is not among the {len(self.topics or ())} topics that are sent")
        if self._owner.submitted(topic_id, now) and line.is_stream:
            self._drop(list(line.queue.shed(now)))
        self._turns.join(topic_id)
        serial = self._serial
        self._serial += 1
        self.stats.submitted[topic_id] += 1
        codec = self._codec
        if self._observer is not None:
            expected = None if codec is None else codec.canonical(topic_id, payload)
            self._observer(Accepted(serial, topic_id, payload, now, expected))
        if codec is not None:
            payload = codec.encode(topic_id, payload)
        if len(payload) > MAX_MESSAGE:
            self._refuse(serial, topic_id, LedgerRow.TOO_LARGE, f"{len(payload)} bytes; at most {MAX_MESSAGE}")
            return
        if line.kept:
            kept = self._kept.setdefault(topic_id, deque(maxlen=max(line.kept_depth, 1)))
            until = inf if line.latched else now + line.topic.options.keep_s
            kept.append(_Kept(serial, payload, codec is not None, crc32(payload), until=until))
        self._admit(
            line,
            Message(serial, topic_id, payload, line.qos, now, line.weight, lifespan_s, coded=codec is not None),
        )

    def forget_kept(self, topic_id: int) -> None:
        """Keep none of the messages of a topic so far for robots that join late."""
        self._kept.pop(topic_id, None)

    def ask(self, topic_id: int, now: float) -> None:
        """Send the kept message of a topic again because a robot lacks it, unless it is waiting already."""
        self._starting_until = min(self._starting_until, now + STARTING_S)
        line = self._lines.get(topic_id)
        if line is None or any(message.repeat for message in line.queue):
            return
        for kept in self._kept.get(topic_id, ()):
            if now > kept.until:
                continue
            if topic_id == TABLE_TOPIC:
                # Nothing is delivered without the table. A long table does not delay urgent messages.
                qos = 1 if len(kept.payload) <= TABLE_FIRST * self._room else 0
                line.queue.append(Message(kept.serial, TABLE_TOPIC, kept.payload, qos, now, repeat=True))
            else:
                qos = QOS_BULK if line.latched else line.qos
                again = Message(
                    kept.serial, topic_id, kept.payload, qos, now, line.weight, repeat=True, coded=kept.coded
                )
                self._admit(line, again)
            self.stats.repeats += 1

    def announce(self, now: float) -> None:
        """Send all kept messages, for robots that cannot ask."""
        for topic_id in self._kept:
            if not self._lines[topic_id].queue:
                self.ask(topic_id, now)

    def marks(self, now: float) -> list[tuple[int, int]]:
        """What hellos name: (topic id, CRC-32) of the newest message that is kept of each topic.

        A receiver remembers no other of a topic. If hellos named older ones too, it would ask for them for ever.
        """
        return [
            (topic_id, messages[-1].mark)
            for topic_id, messages in self._kept.items()
            if topic_id != TABLE_TOPIC and messages[-1].named <= now <= messages[-1].until
        ]

    def follow(
        self,
        topic_id: int,
        *,
        reliable: bool = True,
        latched: bool = False,
        depth: int = 0,
        lifespan_s: float = 0.0,
        period_s: float = 0.0,
    ) -> bool:
        """See :class:`gr_ros2.link.endpoint.MessageSide`."""
        queue = self.queue(topic_id)
        line = self._lines[topic_id]
        topic = line.topic
        line.depth, line.ordered = depth, reliable
        line.latched = topic.latched or (latched and topic.options.durability == AUTO)
        line.queue.change(*queue_for(topic.options, depth, lifespan_s, period_s, command=line.command))
        self._find_deadlines()
        if self._tabulate():
            self._owner.topics_changed()
        return self.queue(topic_id) != queue

    def queue(self, topic_id: int) -> tuple[QueuePolicy, float]:
        """Policy and deadline (s, 0 for none) of a topic's queue."""
        queue = self._lines[topic_id].queue
        return queue.policy, queue.deadline_s

    def reconfigure(self, settings: Settings) -> None:
        """Use other settings from now on."""
        self._settings = settings

    def expire(self, now: float, interval: float) -> None:
        """Drop messages that would arrive too late."""
        for queue in self.deadlines:
            if queue:
                self._drop(list(queue.expire(now, interval, LEAD_S, self._room - _ENTRY)))

    def fill(self, number: int, room: int, now: float) -> Filling | None:
        """Take what goes into the next source packet.

        :param number: number of that packet
        :param room: bytes that its body may have
        :return: None if nothing may be sent
        """
        heap = self._heap(now)
        if not heap:
            return None
        picks: list[tuple[Message, int]] = []
        used = 0
        while heap and used < room:
            _, _, topic_id, position = heappop(heap)
            queue = self._open[topic_id]
            message = queue[position]
            assert isinstance(message, Message)
            remaining = message.remaining
            taken, size = fit(room - used, remaining, number - message.begin, message.offset)
            if taken < 0 or not (taken == remaining or self._may_cut(message, taken, used, room)):
                continue
            picks.append((message, taken))
            used += size
            if taken == remaining and position + 1 < len(queue):
                following = queue[position + 1]
                worth = value(following, message.submitted, _ENTRY)
                heappush(heap, (self._rank(following), -worth, topic_id, position + 1))
        if not picks:
            return None
        return self._take(picks, number, used, now)

    def next_timeout(self, now: float) -> float | None:
        """When ``fill`` may have something; None if nothing waits."""
        times = [
            opens if (opens := line.queue.opens(now)) < inf else now for line in self._lines.values() if line.queue
        ]
        return min(times) if times else None

    @property
    def urgent(self) -> bool:
        """Whether a message of class latency waits. The table of topics does not count: it follows a hello."""
        return any(line.queue and line.queue[0].qos == QOS_LATENCY for line in self._sending())

    def _rank(self, message: Outgoing) -> float:
        return RANK[message.qos] + 0.5 * self._long(message)

    def _long(self, message: Outgoing) -> bool:
        return len(message.payload) > LONG * self._room

    @property
    def idle(self) -> bool:
        """Whether nothing waits."""
        return not any(line.queue for line in self._lines.values())

    def queued(self) -> dict[int, int]:
        """Messages that wait or are partly sent, per topic id."""
        return {line.topic.topic_id: len(line.queue) for line in self._sending()}

    def room(self, topic_id: int) -> bool:
        """Whether a message of that topic could be submitted without dropping another one."""
        line = self._lines[topic_id]
        return line.queue.room(self._queue_depth(line))

    def _tabulate(self) -> bool:
        """Make the table of topics; returns whether it has changed."""
        rows = []
        for line in self._sending():
            if line.hidden:
                continue
            topic, options = line.topic, line.topic.options
            depth = min(line.kept_depth if line.kept else line.depth if options.depth == AUTO else options.depth, 255)
            codec = "" if self._codec is None else self._codec.announcement(topic.topic_id)
            fresh = line.queue.deadline_s > 0 or topic.type_name == CALLS_TYPE
            if options.max_age_s != AUTO:
                fresh = options.max_age_s > 0
            rows.append(
                AnnouncedTopic(
                    topic.topic_id,
                    topic.name,
                    topic.type_name,
                    line.qos,
                    line.in_order,
                    line.kept,
                    depth,
                    codec,
                    fresh,
                )
            )
        if not rows and not self.digest:
            return False
        table, before = write_table(rows), self.digest
        self.digest = crc32(table)
        self._kept[TABLE_TOPIC] = deque([_Kept(-1, table, False, self.digest)])
        return self.digest != before

    def _sending(self) -> Iterator[_Line]:
        """All topics, without the table of topics."""
        return (line for topic_id, line in self._lines.items() if topic_id != TABLE_TOPIC)

    def _find_deadlines(self) -> None:
        self.deadlines = [line.queue for line in self._lines.values() if line.queue.deadline_s]

    def depth(self, topic_id: int) -> int:
        """Number of messages of a topic that may wait, 0 for unbounded."""
        return self._queue_depth(self._lines[topic_id])

    def _queue_depth(self, line: _Line) -> int:
        depth = line.topic.options.queue_depth
        return self._settings.queue_depth if depth == AUTO else depth

    def _admit(self, line: _Line, message: Message) -> None:
        if dropped := line.queue.admit(message, self._queue_depth(line)):
            self._drop(dropped)

    def _heap(self, now: float) -> list[tuple[float, float, int, int]]:
        """Topics that may send, the most urgent and most valuable first."""
        self._open = {}
        for topic_id, line in self._lines.items():
            if line.queue and (ready := line.queue.open(now)):
                self._open[topic_id] = ready
        heap: list[tuple[float, float, int, int]] = []
        if not self._open:
            return heap
        holder = self._holder = self._turns.holder(self._open)
        for topic_id, ready in self._open.items():
            head, before = ready[0], self._lines[topic_id].newest
            worth = value(head, before if before > -inf else head.submitted - FIRST_AGE_S, _ENTRY)
            rank = self._rank(head)
            heap.append((-1 if rank and topic_id == holder else rank, -worth, topic_id, 0))
        heapify(heap)
        return heap

    def _may_cut(self, message: Message, taken: int, used: int, room: int) -> bool:
        """Whether a fragment of this many bytes is worth its header."""
        if not used:
            return True
        if taken < (MIN_FRAGMENT if message.qos == 1 else room // SHARE):
            return False
        return message.started or message.qos == 1 or message.remaining > LARGE * room

    def _take(self, picks: list[tuple[Message, int]], number: int, used: int, now: float) -> Filling:
        parts: list[EntryV1] = []
        sent: list[SentEntry] = []
        lifetimes: list[Lifetime] = []
        stats, qos = self.stats, picks[0][0].qos
        for place, (message, taken) in enumerate(picks):
            topic_id, offset = message.topic_id, message.offset
            line = self._lines[topic_id]
            if not message.index:
                message.begin, message.place = number, place
                message.lifetime.expires = message.expires
                message.lifetime.in_order, message.lifetime.long = line.in_order, self._long(message)
                line.queue.started(now)
            message.lifetime.awaited = len(line.queue) > 1
            payload = message.take(taken)
            last, begin = message.offset == len(message.payload), message.begin
            parts.append(Part(topic_id, payload, number - begin if offset else 0, offset, last, message.coded))
            key = Key(self._boot, begin, message.place)
            total = message.index if last else 0
            sent.append(SentEntry(message.serial, topic_id, key, message.index - 1, total, message.repeat))
            lifetimes.append(message.lifetime)
            if RANK[message.qos] < RANK[qos]:
                qos = message.qos
            stats.payload_bytes += taken
            if last:
                line.queue.popleft()
                self._left(message, line, now)
        self._turns.sent(self._holder)
        stats.entries += len(picks)
        free = (message.submitted for message, _ in picks if not self._lines[message.topic_id].topic.options.max_rate)
        return Filling(parts, tuple(sent), tuple(lifetimes), qos, used, min(free, default=inf))

    def _left(self, message: Message, line: _Line, now: float) -> None:
        """A message has left whole: older messages that it replaces are over."""
        topic_id, lifetime = message.topic_id, message.lifetime
        line.newest = max(line.newest, message.submitted)
        self.stats.sent[topic_id] += not message.repeat
        lifetimes = line.lifetimes
        most = UNREPORTED_DEPTH
        if line.queue.policy == "latest":
            most = 1
        elif self.reported:
            most = MOST_LIFETIMES if line.in_order else line.depth or REPORTED_DEPTH
        elif lifetimes:
            before, _ = lifetimes[-1]
            before.expires = min(before.expires, now + WORTH * self._settings.hold_s)
        lifetimes.append((lifetime, message.index))
        line.packets += message.index
        while len(lifetimes) > 1 and (
            len(lifetimes) > most or (line.packets - lifetimes[0][1] > GROUP and not self.reported)
        ):
            replaced, count = lifetimes.popleft()
            replaced.end()
            line.packets -= count
        if topic_id not in self._kept:
            return
        for kept in self._kept[topic_id]:
            if kept.payload is message.payload and kept.named == inf:
                kept.named = now + SETTLING_S
        if not self.reported:
            # Later the table is sent again, and is small; at the start, nothing can be delivered without it.
            table, waited = topic_id == TABLE_TOPIC, now - message.submitted
            lifetime.expires = self._starting_until if table else min(lifetime.expires, now + 2 * waited + 2.0)

    def _drop(self, dropped: list[Dropped]) -> None:
        for item in dropped:
            item.message.index = max(item.message.index, 1)
            if isinstance(item.message, Message):
                item.message.lifetime.end()
            if not item.message.repeat:
                self._refuse(item.message.serial, item.message.topic_id, item.row, item.detail)

    def _refuse(self, serial: int, topic_id: int, reason: LedgerRow, detail: str) -> None:
        self.stats.refused[topic_id, reason.value] += 1
        if self._observer is not None:
            self._observer(Refused(serial, topic_id, reason, detail))


def _line(topic: Topic, queue: TopicQueue, *, command: bool = False) -> _Line:
    options, hidden = topic.options, not topic.is_topic
    qos = qos_class(options, command=command)
    return _Line(topic, queue, qos, options.weight, topic.latched, hidden=hidden, command=command)
