"""The sending engine: messages in, packets out.

Laws: every submitted message is accepted once and then leaves whole or is refused with a named reason; a message
whose first fragment has left is never dropped; packets come out only when the pace (rate or credit) allows; time is
an argument and never goes back.
"""

from __future__ import annotations

import random
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field, fields
from typing import Any

from gr_ros2.config import SourceConfig, build
from gr_ros2.errors import ConfigError
from gr_ros2.link.events import Accepted, Refused, SenderEvent, SentEntry, SentPacket
from gr_ros2.link.fragment import Outgoing, largest_message, smallest_packet_len
from gr_ros2.link.schedule import SCHEDULER, Plan, Scheduler
from gr_ros2.registry import Registry
from gr_ros2.wire import QOS_BULK, QOS_DEFAULT, QOS_LATENCY, Packet, encode

QOS_CODES = {"default": QOS_DEFAULT, "latency": QOS_LATENCY, "bulk": QOS_BULK}
LIVE_SETTINGS = ("packet_rate", "flush_timeout", "greedy", "dst_id", "hop", "repeat_s", "queue_depth")
"""Settings that make sense to change while running."""

Observer = Callable[[SenderEvent], None]


@dataclass(slots=True)
class SenderStats:
    """What left and what did not, since the start. ``refused`` is keyed by (topic_id, reason)."""

    submitted: Counter[int] = field(default_factory=Counter)
    refused: Counter[tuple[int, str]] = field(default_factory=Counter)
    sent: Counter[int] = field(default_factory=Counter)
    repeats: int = 0
    packets: int = 0
    entries: int = 0
    payload_bytes: int = 0


class Sender:
    """Cuts, queues and packs messages of one source.

    :param registry: gives topic ids their options; ``config.topic_options`` go over them
    :param rng: seeds the start of sequence number and entry ids, and gives random ids where those are configured
    :param observer: called with every SenderEvent, in order
    """

    def __init__(
        self,
        registry: Registry,
        config: SourceConfig,
        *,
        rng: random.Random | None = None,
        observer: Observer | None = None,
    ) -> None:
        self.config = config
        self.registry = registry.with_options(config.topic_options)
        self.src_id = config.src_id()
        self.stats = SenderStats()
        self._rng = rng if rng is not None else random.Random()
        self._observer = observer
        self._scheduler: Scheduler = SCHEDULER.load(config.scheduler)(config)
        self._queues: dict[int, deque[Outgoing]] = {topic.topic_id: deque() for topic in self.registry}
        self._next_id = [self._rng.randrange(256) for _ in self.registry]
        self._seq = self._rng.randrange(256)
        self._serial = 0
        self._slot = float("-inf")
        self._credits: int | None = None
        self._latched: dict[int, bytes] = {}
        self._repeat_at: dict[int, float] = {}

    def submit(self, topic_id: int, payload: bytes, now: float) -> None:
        """Take a serialized message.

        It may be refused (``too_large``), and may push out the oldest waiting message of its topic
        (``queue_bound``); both are counted and observed.

        :raises ConfigError: for a topic id that is not in the registry
        """
        if not 0 <= topic_id < len(self.registry):
            raise ConfigError(f"topic id {topic_id} is not in the registry of {len(self.registry)} topics")
        serial = self._serial
        self._serial += 1
        self.stats.submitted[topic_id] += 1
        self._observe(Accepted(serial, topic_id, payload, now))
        if len(payload) > largest_message(self.config.packet_len):
            self._refuse(serial, topic_id, "too_large", self._too_large(len(payload)))
            return
        topic = self.registry[topic_id]
        queue = self._queues[topic_id]
        self._make_room(topic_id)
        queue.append(Outgoing(serial, topic_id, payload, QOS_CODES[topic.options.qos], now))
        if topic.latched:
            self._latched[topic_id] = payload
            self._repeat_at[topic_id] = now + self.config.repeat_s

    def next_packet(self, now: float) -> bytes | None:
        """The next packet that may go at ``now``, or None."""
        if self._credits == 0 or now < self._slot:
            return None
        self._repeat(now)
        plan = self._scheduler.plan(self._queues)
        if plan is None or now < self._departure(plan):
            return None
        data = self._compose(plan, now)
        if self._credits is not None:
            self._credits -= 1
        if self.config.packet_rate > 0:
            interval = 1 / self.config.packet_rate
            # A slot missed by less than its length is made up for, so that late wake-ups cost no rate.
            self._slot = max(self._slot, now - interval) + interval
        return data

    def next_timeout(self) -> float | None:
        """Earliest time at which ``next_packet`` may give something without a further submit or credit."""
        if self._credits == 0:
            return None
        times = list(self._repeat_at.values()) if self.config.repeat_s > 0 else []
        plan = self._scheduler.plan(self._queues)
        if plan is not None:
            times.append(self._departure(plan))
        return max(min(times), self._slot) if times else None

    def use_credit(self) -> None:
        """From now on a packet leaves only for a credit."""
        if self._credits is None:
            self._credits = 0

    def credit(self, packets: int = 1) -> None:
        """The PHY can take so many further packets; the first call does what ``use_credit`` does."""
        self._credits = (self._credits or 0) + packets

    def room(self, topic_id: int) -> bool:
        """Whether a message of that topic could be submitted without pushing another out."""
        depth = self._depth(topic_id)
        return not depth or len(self._queues[topic_id]) < depth

    @property
    def idle(self) -> bool:
        """Whether nothing is waiting."""
        return not any(self._queues.values())

    def queued(self) -> dict[int, int]:
        """Messages waiting or under way, per topic id."""
        return {topic_id: len(queue) for topic_id, queue in self._queues.items()}

    def reconfigure(self, **settings: Any) -> None:
        """Change settings while running.

        :raises ConfigError: for a value out of range or a setting that cannot change
        """
        for name in settings:
            if name not in LIVE_SETTINGS:
                raise ConfigError(f"{name} cannot change while running; these can: {', '.join(LIVE_SETTINGS)}")
        current = {item.name: getattr(self.config, item.name) for item in fields(SourceConfig)}
        self.config = build(SourceConfig, {**current, **settings})
        self._scheduler.config = self.config
        if "packet_rate" in settings:
            self._slot = float("-inf")

    def _depth(self, topic_id: int) -> int:
        depth = self.registry[topic_id].options.queue_depth
        return self.config.queue_depth if depth is None else depth

    def _make_room(self, topic_id: int) -> None:
        """Drop the oldest messages that have not started until one more fits the bound."""
        queue = self._queues[topic_id]
        depth = self._depth(topic_id)
        while depth and len(queue) >= depth:
            victim = next((message for message in queue if not message.started), None)
            if victim is None:
                return
            queue.remove(victim)
            if victim.serial >= 0:
                self._refuse(victim.serial, topic_id, "queue_bound", f"{depth} messages were waiting")

    def _departure(self, plan: Plan) -> float:
        """When a planned packet may leave: at once if full, else after it has waited for company."""
        if plan.full or self.config.flush_timeout == 0:
            return float("-inf")
        return min(message.submitted for message in plan.picks) + self.config.flush_timeout

    def _compose(self, plan: Plan, now: float) -> bytes:
        config = self.config
        entries = []
        record = []
        for message in plan.picks:
            if not message.started:
                message.entry_id = self._take_id(message.topic_id)
            entry = message.next_entry()
            entries.append(entry)
            record.append(SentEntry(message.serial, entry.topic_id, entry.entry_id, entry.index, entry.total))
            if message.done:
                self._queues[message.topic_id].remove(message)
                self.stats.sent[message.topic_id] += message.serial >= 0
        data = encode(
            Packet(self.src_id, config.dst_id, self._seq, config.hop, tuple(entries), qos=_packet_qos(plan)),
            config.packet_len,
        )
        self._seq = (self._seq + 1) & 255
        self._scheduler.sent(plan)
        stats = self.stats
        stats.packets += 1
        stats.entries += len(entries)
        stats.payload_bytes += sum(len(entry.payload) for entry in entries)
        self._observe(SentPacket(data, tuple(record), now))
        return data

    def _take_id(self, topic_id: int) -> int:
        if self.config.entry_ids == "random":
            return self._rng.randrange(256)
        entry_id = self._next_id[topic_id]
        self._next_id[topic_id] = (entry_id + 1) & 255
        return entry_id

    def _repeat(self, now: float) -> None:
        """Queue again what late robots need, once nothing newer of that topic is waiting."""
        if self.config.repeat_s <= 0:
            return
        for topic_id, at in self._repeat_at.items():
            if now >= at:
                self._repeat_at[topic_id] = now + self.config.repeat_s
                if not self._queues[topic_id]:
                    self._queues[topic_id].append(Outgoing(-1, topic_id, self._latched[topic_id], QOS_BULK, now))
                    self.stats.repeats += 1

    def _too_large(self, size: int) -> str:
        needed = smallest_packet_len(size)
        remedy = f"packet_len {needed} would carry it" if needed else "no packet_len would carry it"
        return f"{size} bytes need over 255 entries at packet_len {self.config.packet_len}; {remedy}"

    def _refuse(self, serial: int, topic_id: int, reason: str, detail: str) -> None:
        self.stats.refused[topic_id, reason] += 1
        self._observe(Refused(serial, topic_id, reason, detail))

    def _observe(self, event: SenderEvent) -> None:
        if self._observer is not None:
            self._observer(event)


def _packet_qos(plan: Plan) -> int:
    """Latency if any entry is, bulk only if all are."""
    classes = {message.qos for message in plan.picks}
    if QOS_LATENCY in classes:
        return QOS_LATENCY
    return QOS_BULK if classes == {QOS_BULK} else QOS_DEFAULT
