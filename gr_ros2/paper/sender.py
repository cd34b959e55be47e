"""The sending engine of version 0, the paper's: messages in, packets out.

Invariants: every submitted message is accepted once and then leaves whole or is refused with a named reason; a message
whose first fragment was sent is not dropped; packets leave only when the pace (rate or credit) allows; a packet is
composed when it is requested, never before; time is an argument and never goes back.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Hashable
from math import inf
from typing import Any
from zlib import crc32

from gr_ros2.core.errors import ConfigError
from gr_ros2.link.endpoint import CodedMessage
from gr_ros2.link.events import SenderEvent, SentEntry, SentPacket
from gr_ros2.link.fates import Fate
from gr_ros2.link.ledger import SenderLedger
from gr_ros2.link.message_codec import MessageCodec
from gr_ros2.link.pace import Pace
from gr_ros2.link.queues import PublisherQos, TopicQueue, qos_class
from gr_ros2.link.stats import SenderStats
from gr_ros2.paper.schedule import Fragmented, PaperScheduler, Plan
from gr_ros2.paper.settings import PaperConfig
from gr_ros2.settings.config import QueuePolicy, replaced
from gr_ros2.settings.fields import AUTO, Auto
from gr_ros2.settings.registry import Registry
from gr_ros2.settings.robot import RobotConfig
from gr_ros2.wire import FORMATS, QOS_BULK, QOS_DEFAULT, QOS_LATENCY
from gr_ros2.wire.v0 import V0, EntryV0, PacketV0

Observer = Callable[[SenderEvent], None]


class Sender:
    """Cuts, queues and packs messages of one source.

    :param registry: gives topic ids their options; those of the robot override them
    :param codec: codes every message, and every packet then has C = 1; events carry the message as submitted
    :param rng: seeds the first sequence number and entry ids, and gives random ids where those are configured
    :param observer: called with every SenderEvent, in order
    """

    def __init__(
        self,
        registry: Registry,
        robot: RobotConfig,
        paper: PaperConfig,
        *,
        codec: MessageCodec | None = None,
        rng: random.Random | None = None,
        observer: Observer | None = None,
    ) -> None:
        self.robot, self.paper = robot, paper
        if len(registry) > V0.max_topics:
            beyond = registry[V0.max_topics]
            raise ConfigError(
                f"topic {V0.max_topics + 1}, {beyond.name!r}: the paper's packets carry {V0.max_topics} topics; "
                f"leave some out, or take a ROS Link, which carries {FORMATS[1].max_topics}"
            )
        self.registry = registry.with_options(robot.options)
        self.src_id = robot.robot_id
        self.stats = SenderStats()
        self._rng = rng if rng is not None else random.Random()
        self._observer = observer
        self.ledger = SenderLedger(self.stats, observer)
        self._codec = codec
        self._largest = V0.largest_message(robot.packet_len)
        self._scheduler = PaperScheduler(robot.packet_len, paper)
        self._queues: dict[int, TopicQueue[Fragmented]] = {
            topic.topic_id: TopicQueue("fifo") for topic in self.registry
        }
        self._classes = [qos_class(topic.options) for topic in self.registry]
        self._depths = [topic.options.queue_depth for topic in self.registry]
        self._keeps = {topic.topic_id for topic in self.registry if topic.latched}
        """Topics whose newest message is kept for robots that join late."""
        self._plan: Plan | None = None
        self._stale = True
        """Whether the waiting messages have changed since the last plan."""
        self._ids, self._numbers = 1 << V0.id_bits, 1 << V0.number_bits
        self._next_id = [self._rng.randrange(self._ids) for _ in self.registry]
        self._seq = self._rng.randrange(self._numbers)
        self.pace = Pace(robot.packet_rate)
        """When packets may leave."""
        self._latched: dict[int, tuple[int, bytes]] = {}
        """Per topic, serial and coded bytes of the message for robots that join late."""
        self._repeat_at: dict[int, float] = {}

    def prepare(self, topic_id: int, payload: bytes) -> CodedMessage | None:  # noqa: ARG002
        return None

    def submit(
        self,
        topic_id: int,
        payload: bytes,
        now: float,
        lifespan_s: float = inf,  # noqa: ARG002 - as in other versions
        dst_id: int | Auto = AUTO,  # noqa: ARG002
        *,
        waited_s: float = 0.0,  # noqa: ARG002
        publisher: Hashable = None,  # noqa: ARG002
        prepared: CodedMessage | None = None,  # noqa: ARG002
    ) -> None:
        """Take a serialized message.

        It may be refused (``too_large``), and it may cause the oldest waiting message of its topic to be dropped
        (``queue_bound``); all are counted and observed.

        :raises ConfigError: for a topic id that is not in the registry
        """
        if topic_id not in self._queues:
            raise ConfigError(f"topic id {topic_id} is not in the registry of {len(self.registry)} topics")
        serial = self.ledger.new(topic_id)
        if self._observer is not None:
            expected = None if self._codec is None else self._codec.canonical(topic_id, payload)
            self.ledger.accept(serial, topic_id, payload, now, expected)
        if self._codec is not None:
            payload = self._codec.encode(topic_id, payload)
        if len(payload) > self._largest:
            self.ledger.refuse(serial, topic_id, Fate.TOO_LARGE, self._too_large(len(payload)))
            return
        message = Fragmented(serial, topic_id, payload, self._classes[topic_id], now)
        for dropped in self._queues[topic_id].admit(message, self.depth(topic_id)):
            if not dropped.message.repeat:
                self.ledger.refuse(dropped.message.serial, topic_id, dropped.fate, dropped.detail)
        self._stale = True
        if topic_id in self._keeps:
            self._latched[topic_id] = (serial, payload)
            self._repeat_at[topic_id] = now + self.robot.repeat_s

    def next_packet(self, now: float) -> SentPacket | None:
        if not self.pace.may_leave(now):
            return None
        if self._repeat_at:
            self._repeat(now)
        plan = self._planned()
        if plan is None or now < self._departure(plan):
            return None
        sent = self._compose(plan, now)
        if self.pace.known:
            self.pace.left(now, waiting=not self.idle)
        return sent

    def next_timeout(self) -> float | None:
        """Earliest time at which ``next_packet`` may return a packet without a further submit or credit."""
        if self.pace.out_of_credit:
            return None
        times = list(self._repeat_at.values()) if self.robot.repeat_s > 0 else []
        plan = self._planned()
        if plan is not None:
            times.append(self._departure(plan))
        return max(min(times), self.pace.slot) if times else None

    def follow(self, topic_id: int, publishers: PublisherQos) -> bool:  # noqa: ARG002
        """Do nothing: messages come as they come, and the registry says the rest at both ends."""
        return False

    def queue(self, topic_id: int) -> tuple[QueuePolicy, float]:  # noqa: ARG002 - all topics have the same
        return "fifo", 0.0

    def depth(self, topic_id: int) -> int:
        depth = self._depths[topic_id]
        return self.robot.queue_depth if depth == AUTO else depth

    def has_space(self, topic_id: int) -> bool:
        return self._queues[topic_id].has_space(self.depth(topic_id))

    @property
    def idle(self) -> bool:
        """Whether nothing is waiting."""
        return not any(self._queues.values())

    def queued(self) -> dict[int, int]:
        return {topic_id: len(queue) for topic_id, queue in self._queues.items()}

    def reconfigure(self, **settings: Any) -> None:
        """Change settings while running.

        :raises ConfigError: for a value out of range
        """
        before = self.robot
        if "dst_id" in settings:
            self.paper = self._scheduler.paper = replaced(self.paper, dst_id=settings.pop("dst_id"))
        self.robot = replaced(self.robot, **settings)
        for topic_id in self._repeat_at:
            self._repeat_at[topic_id] += self.robot.repeat_s - before.repeat_s
        self._stale = True
        if "packet_rate" in settings:
            self.pace.change(self.robot.packet_rate)

    def _planned(self) -> Plan | None:
        """The next packet's content; planned again only when something has changed."""
        if self._stale:
            self._plan = self._scheduler.plan(self._queues)
            self._stale = False
        return self._plan

    def _departure(self, plan: Plan) -> float:
        """When a planned packet may leave: at once if it is full, otherwise after ``flush_timeout_s``."""
        if plan.full or self.paper.flush_timeout_s == 0:
            return -inf
        waits = (min(message.submitted, self._queues[message.topic_id].since) for message in plan.picks)
        return min(waits) + self.paper.flush_timeout_s

    def _compose(self, plan: Plan, now: float) -> SentPacket:
        entries = []
        record = []
        for message, length in zip(plan.picks, plan.lengths, strict=True):
            if not message.started:
                message.entry_id = self._take_id(message.topic_id)
                self._queues[message.topic_id].started(message, now)
            entry = EntryV0(message.topic_id, message.entry_id, message.index, message.total, message.take(length))
            entries.append(entry)
            record.append(
                SentEntry(message.serial, entry.topic_id, entry.entry_id, entry.index, entry.total, message.repeat)
            )
            if message.done:
                self._queues[message.topic_id].popleft()
                self.stats.sent[message.topic_id] += not message.repeat
        packet = PacketV0(
            self.src_id,
            self.paper.dst_id,
            self._seq,
            self.paper.hop,
            tuple(entries),
            qos=_packet_qos(plan),
            compressed=self._codec is not None,
        )
        data = V0.encode(packet, self.robot.packet_len)
        sent = SentPacket(data, packet, self.src_id, 0, self._seq, crc32(data), tuple(record), now)
        self._seq = (self._seq + 1) % self._numbers
        self._scheduler.sent(plan)
        self._stale = True
        stats = self.stats
        stats.packets += 1
        stats.air["new"] += 1
        stats.entries += len(entries)
        stats.payload_bytes += sum(plan.lengths)
        if self._observer is not None:
            self._observer(sent)
        return sent

    def _take_id(self, topic_id: int) -> int:
        if self.paper.entry_ids == "random":
            return self._rng.randrange(self._ids)
        entry_id = self._next_id[topic_id]
        self._next_id[topic_id] = (entry_id + 1) % self._ids
        return entry_id

    def _repeat(self, now: float) -> None:
        """Queue the message for robots that join late again, if nothing newer of that topic is waiting."""
        if self.robot.repeat_s <= 0:
            return
        for topic_id, at in self._repeat_at.items():
            if now >= at:
                self._repeat_at[topic_id] = now + self.robot.repeat_s
                if not self._queues[topic_id]:
                    serial, payload = self._latched[topic_id]
                    self._queues[topic_id].append(Fragmented(serial, topic_id, payload, QOS_BULK, now, repeat=True))
                    self.stats.repeats += 1
                    self._stale = True

    def _too_large(self, size: int) -> str:
        needed = V0.smallest_packet_len(size)
        remedy = f"packet_len {needed} would carry it" if needed else "no packet_len would carry it"
        return f"{size} bytes need over {V0.max_fragments} entries at packet_len {self.robot.packet_len}; {remedy}"


def _packet_qos(plan: Plan) -> int:
    """The packet's class: latency if any entry is latency, bulk only if all are bulk."""
    if len(plan.picks) == 1:
        return plan.picks[0].qos
    classes = {message.qos for message in plan.picks}
    if QOS_LATENCY in classes:
        return QOS_LATENCY
    return QOS_BULK if classes == {QOS_BULK} else QOS_DEFAULT
