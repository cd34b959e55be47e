"""The receiving engine: bytes from the PHY in, messages out.

Invariants: ``receive`` trusts no byte and never raises, whatever the bytes; everything dropped is counted by name;
memory is bounded per source and in total; time is an argument and never goes back.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from zlib import crc32

from gr_ros2.core.errors import CodecError, WireError
from gr_ros2.link.events import AirPacket, Delivered, Lost, Received, ReceiverEvent, Rejected
from gr_ros2.link.fates import FATES, Fate
from gr_ros2.link.message_codec import MessageCodec
from gr_ros2.link.stats import ReceiverStats
from gr_ros2.paper.partials import Partial, Partials
from gr_ros2.paper.reassemble import Context, TopicReassembler
from gr_ros2.paper.sequence import Arrival, SequenceTracker
from gr_ros2.paper.settings import PaperConfig
from gr_ros2.settings.config import NOBODY
from gr_ros2.settings.registry import Registry
from gr_ros2.settings.robot import RobotConfig
from gr_ros2.wire import BROADCAST
from gr_ros2.wire.v0 import V0, PacketV0

SOURCE_IDLE_S = 60.0
"""A source that was silent for this many seconds is replaced by a new one when ``max_sources`` are known."""
MAX_BYTES = 64_000_000
"""Of incomplete messages of all senders."""


@dataclass(slots=True)
class _Source:
    last: float
    sequence: SequenceTracker = field(default_factory=SequenceTracker)
    topics: dict[int, TopicReassembler] = field(default_factory=dict)
    latched: dict[int, bytes] = field(default_factory=dict)
    epoch: int = 0


class Receiver:
    """Reassembles the messages of every source heard.

    :param registry: says which topic ids exist and which are transient-local
    :param codec: decodes messages from packets with C = 1; without it, such packets are ``unsupported``
    :param own: number of the robot, None as the settings say; ``NOBODY`` takes packets of all robots for all
    :param max_bytes: of incomplete messages in all
    """

    def __init__(
        self,
        registry: Registry,
        robot: RobotConfig,
        paper: PaperConfig,
        *,
        codec: MessageCodec | None = None,
        own: int | None = None,
        max_bytes: int = MAX_BYTES,
    ) -> None:
        self.robot, self.paper, self._max_bytes = robot, paper, max_bytes
        self._own = robot.robot_id if own is None else own
        self.registry = registry.with_options(robot.publish.topics)
        self.stats = ReceiverStats()
        self._topics = len(self.registry)
        self._latched = {topic.topic_id for topic in self.registry if topic.latched}
        self._codec = codec
        self._sources: dict[int, _Source] = {}
        self._partials = Partials()

    def receive(self, arrival: AirPacket, now: float) -> list[ReceiverEvent]:
        """Take one packet; the events it causes, in order."""
        data = arrival.data
        events = self.handle_timeout(now) if self._partials.size else []
        try:
            packet = V0.decode(data, self.robot.packet_len)
        except WireError as error:
            self.stats.rejected[error.kind] += 1
            events.append(Rejected(data, error.alone()))
            return events
        self.stats.packets += 1
        events.append(Received(data, packet, packet.src_id, 0, packet.seq, crc32(data), arrival.at, arrival.snr_db))
        source = self._admit(packet, now)
        if source is not None:
            self._take(source, packet, data, now, events)
        return events

    def handle_timeout(self, now: float) -> list[ReceiverEvent]:
        """Give up messages that have waited ``reassembly_timeout_s`` for their next fragment."""
        events: list[ReceiverEvent] = []
        while (at := self.next_timeout()) is not None and at <= now:
            events.append(self._given_up(self._partials.take(self._partials.oldest()), Fate.EXPIRED))
        return events

    def next_timeout(self) -> float | None:
        """When ``handle_timeout`` has something to do, None if no message is incomplete."""
        for partial in self._partials:
            return partial.last + self.paper.reassembly_timeout_s
        return None

    def unpublished(self, event: Delivered) -> Lost:
        """Record a delivered message that could not be published on the ROS graph. A repeat of it is delivered
        again."""
        source = self._sources.get(event.src_id)
        if source is not None and source.latched.get(event.topic_id) == event.payload:
            del source.latched[event.topic_id]
        self.stats.lost[event.src_id, event.topic_id, Fate.PUBLISH_FAILED.value] += 1
        return Lost(event.src_id, event.topic_id, Fate.PUBLISH_FAILED, event.key)

    def knows(self, src_id: int) -> bool:
        return src_id in self._sources

    @property
    def held_bytes(self) -> int:
        return self._partials.size

    def _admit(self, packet: PacketV0, now: float) -> _Source | None:
        """The source of a packet, None if the packet is not for this receiver."""
        own = self._own
        if own != NOBODY:
            if packet.src_id == own:
                self.stats.dropped["own"] += 1
                return None
            if packet.dst_id not in (own, BROADCAST):
                self.stats.dropped["not_for_us"] += 1
                return None
        source = self._sources.get(packet.src_id)
        if source is None:
            if len(self._sources) >= self.robot.max_sources:
                idle = min(self._sources, key=lambda src_id: self._sources[src_id].last)
                if now - self._sources[idle].last < SOURCE_IDLE_S or self._partials.size_of(idle):
                    self.stats.dropped["max_sources"] += 1
                    return None
                del self._sources[idle]
                self._partials.forget(idle)
            source = self._sources[packet.src_id] = _Source(now)
        source.last = now
        return source

    def _take(self, source: _Source, packet: PacketV0, data: bytes, now: float, events: list[ReceiverEvent]) -> None:
        placed = source.sequence.place(packet.seq, data, now)
        if placed.arrival is Arrival.DUPLICATE:
            self.stats.dropped["duplicate"] += 1
            return
        src_id = packet.src_id
        steady = placed.arrival is Arrival.NEXT
        if not steady:
            source.epoch += 1
            self.stats.missed[src_id] += placed.missing or 0
            self.stats.unknown_gaps += placed.missing is None
            if placed.arrival is Arrival.LATE:
                self.stats.missed[src_id] = max(self.stats.missed[src_id] - 1, 0)
            elif placed.arrival is Arrival.RESET:
                for topic in source.topics.values():
                    events += [self._given_up(partial, Fate.LOST_FRAGMENTS) for partial in topic.reset()]
        flags = packet.compressed << 1 | packet.encrypted
        context = Context(placed.position, source.epoch, steady, flags, now)
        for entry in packet.entries:
            if entry.topic_id >= self._topics:
                self.stats.dropped["unknown_topic"] += 1
                continue
            reassembler = source.topics.get(entry.topic_id)
            if reassembler is None:
                reassembler = TopicReassembler(src_id, entry.topic_id, self._partials)
                source.topics[entry.topic_id] = reassembler
            missed = reassembler.missed_ids
            message, ended = reassembler.accept(entry, context)
            self.stats.message_loss_est += reassembler.missed_ids - missed
            if ended:
                events += [self._given_up(partial, Fate.LOST_FRAGMENTS) for partial in ended]
            if message is not None:
                events += self._deliver(source, packet, entry.topic_id, entry.entry_id, message)
        source.epoch += placed.arrival is Arrival.LATE
        if not self._partials.size:
            return
        while self._partials.size_of(src_id) > self.robot.max_source_bytes:
            events.append(self._given_up(self._partials.take(self._partials.oldest(src_id)), Fate.MEMORY))
        while self._partials.size > self._max_bytes:
            events.append(self._given_up(self._partials.take(self._partials.oldest()), Fate.MEMORY))

    def _deliver(
        self, source: _Source, packet: PacketV0, topic_id: int, entry_id: int, payload: bytes
    ) -> Iterable[ReceiverEvent]:
        if packet.encrypted or (packet.compressed and self._codec is None):
            return [self._undone(packet, topic_id, entry_id, Fate.UNSUPPORTED)]
        if packet.compressed and self._codec is not None:
            try:
                payload = self._codec.decode(topic_id, payload)
            except CodecError as error:
                return [self._undone(packet, topic_id, entry_id, FATES[error.fate])]
        if topic_id in self._latched:
            if source.latched.get(topic_id) == payload:
                self.stats.repeats += 1
                return []
            source.latched[topic_id] = payload
        self.stats.delivered[packet.src_id, topic_id] += 1
        return [Delivered(packet.src_id, topic_id, payload, packet.qos, entry_id)]

    def _undone(self, packet: PacketV0, topic_id: int, entry_id: int, fate: Fate) -> Lost:
        """Record a complete message that cannot be decoded here."""
        self.stats.lost[packet.src_id, topic_id, fate.value] += 1
        return Lost(packet.src_id, topic_id, fate, entry_id)

    def _given_up(self, partial: Partial, fate: Fate) -> Lost:
        """Record an incomplete message that is no longer held."""
        self.stats.lost[partial.src_id, partial.topic_id, fate.value] += 1
        self.stats.message_loss_est += 1
        return Lost(partial.src_id, partial.topic_id, fate, partial.entry_id)
