"""The receiving engine: bytes from the PHY in, messages out.

Laws: nothing but the bytes is trusted; ``receive`` never raises whatever the bytes; everything dropped is counted by
name; memory is bounded per source and in all; time is an argument and never goes back.
"""

from __future__ import annotations

from collections import Counter, OrderedDict
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

from gr_ros2.config import SinkConfig
from gr_ros2.errors import CodecError, WireError
from gr_ros2.link.codec import MessageCodec
from gr_ros2.link.events import Delivered, Lost, ReceiverEvent, Rejected
from gr_ros2.link.reassemble import Context, Partial, TopicReassembler
from gr_ros2.link.sequence import Arrival, SequenceTracker
from gr_ros2.registry import Registry
from gr_ros2.wire import BROADCAST
from gr_ros2.wire.v0 import V0, Packet

SOURCE_IDLE_S = 60.0
"""A source silent for so long gives its place to a new one when ``max_sources`` are known."""

PUBLISH_FAILED = "publish_failed"
"""Ledger row of a message that arrived complete and did not come onto the ROS graph."""

Observer = Callable[[ReceiverEvent], None]


@dataclass(slots=True)
class ReceiverStats:
    """What arrived and what did not, since the start.

    ``rejected`` by kind of WireError; ``dropped`` by name: own, not_for_us, duplicate, max_sources, unknown_topic;
    ``delivered``, what was given out, by (src_id, topic_id); ``lost`` by (src_id, topic_id, reason);
    ``packet_loss_est`` from gaps in sequence numbers and ``message_loss_est`` from gaps in entry ids and messages given
    up are estimates; ``unknown_gaps`` counts where a sender restarted or was silent for long, so that nothing is known
    of what was lost.
    """

    packets: int = 0
    rejected: Counter[str] = field(default_factory=Counter)
    dropped: Counter[str] = field(default_factory=Counter)
    delivered: Counter[tuple[int, int]] = field(default_factory=Counter)
    lost: Counter[tuple[int, int, str]] = field(default_factory=Counter)
    repeats: int = 0
    packet_loss_est: int = 0
    unknown_gaps: int = 0
    message_loss_est: int = 0


@dataclass(slots=True)
class _Source:
    last: float
    sequence: SequenceTracker = field(default_factory=SequenceTracker)
    topics: dict[int, TopicReassembler] = field(default_factory=dict)
    latched: dict[int, bytes] = field(default_factory=dict)
    size: int = 0
    epoch: int = 0


class Receiver:
    """Reassembles the messages of every source heard.

    :param registry: says which topic ids exist and which are transient-local
    :param observer: called with every ReceiverEvent, in order
    :param codec: decodes messages from packets with C = 1, which without it are ``unsupported``
    """

    def __init__(
        self,
        registry: Registry,
        config: SinkConfig,
        *,
        observer: Observer | None = None,
        codec: MessageCodec | None = None,
    ) -> None:
        self.config = config
        self.registry = registry.with_options(config.topic_options)
        self.stats = ReceiverStats()
        self._observer = observer
        self._codec = codec
        self._sources: dict[int, _Source] = {}
        self._partials: OrderedDict[Partial, int] = OrderedDict()
        """Everything incomplete and its source, longest without a new fragment first."""
        self._size = 0

    def receive(self, data: bytes, now: float) -> list[ReceiverEvent]:
        """Take the bytes of one packet; the events it causes, in order."""
        events = self.handle_timeout(now)
        try:
            packet = V0.decode(data, self.config.packet_len)
        except WireError as error:
            self.stats.rejected[error.kind] += 1
            return self._report(events, [Rejected(error)])
        self.stats.packets += 1
        source = self._admit(packet, now)
        if source is not None:
            self._report(events, self._take(source, packet, data, now))
        return events

    def handle_timeout(self, now: float) -> list[ReceiverEvent]:
        """Give up what has waited ``reassembly_timeout`` for its next fragment."""
        ended: list[Partial] = []
        for partial in self._partials:
            if partial.last + self.config.reassembly_timeout > now:
                break
            ended.append(partial)
        return self._report([], [self._abandon(partial, "expired") for partial in ended])

    def next_timeout(self) -> float | None:
        """When ``handle_timeout`` has something to do, None while nothing is incomplete."""
        for partial in self._partials:
            return partial.last + self.config.reassembly_timeout
        return None

    def unpublished(self, event: Delivered) -> Lost:
        """Book a message that was given out but did not come onto the ROS graph. A repeat of it is given out again."""
        source = self._sources.get(event.src_id)
        if source is not None and source.latched.get(event.topic_id) == event.payload:
            del source.latched[event.topic_id]
        self.stats.lost[event.src_id, event.topic_id, PUBLISH_FAILED] += 1
        return Lost(event.src_id, event.topic_id, PUBLISH_FAILED, event.entry_id)

    def knows(self, src_id: int) -> bool:
        """Whether a sender has a place at present."""
        return src_id in self._sources

    @property
    def held_bytes(self) -> int:
        """Memory in use for incomplete messages."""
        return self._size

    def _admit(self, packet: Packet, now: float) -> _Source | None:
        """The source of a packet that concerns us."""
        own = self.config.robot_id
        if own >= 0:
            if packet.src_id == own:
                self.stats.dropped["own"] += 1
                return None
            if packet.dst_id not in (own, BROADCAST):
                self.stats.dropped["not_for_us"] += 1
                return None
        source = self._sources.get(packet.src_id)
        if source is None:
            if len(self._sources) >= self.config.max_sources:
                idle = min(self._sources, key=lambda src_id: self._sources[src_id].last)
                if now - self._sources[idle].last < SOURCE_IDLE_S or self._sources[idle].size:
                    self.stats.dropped["max_sources"] += 1
                    return None
                del self._sources[idle]
            source = self._sources[packet.src_id] = _Source(now)
        source.last = now
        return source

    def _take(self, source: _Source, packet: Packet, data: bytes, now: float) -> list[ReceiverEvent]:
        placed = source.sequence.place(packet.seq, data, now)
        if placed.arrival is Arrival.DUPLICATE:
            self.stats.dropped["duplicate"] += 1
            return []
        events: list[ReceiverEvent] = []
        steady = placed.arrival is Arrival.NEXT
        if not steady:
            source.epoch += 1
            self.stats.packet_loss_est += placed.missing or 0
            self.stats.unknown_gaps += placed.missing is None
            if placed.arrival is Arrival.LATE:
                self.stats.packet_loss_est = max(self.stats.packet_loss_est - 1, 0)
            elif placed.arrival is Arrival.RESET:
                ended = [partial for topic in source.topics.values() for partial in topic.reset()]
                events += [self._forget(partial, packet.src_id, "lost_fragments") for partial in ended]
        flags = packet.compressed << 1 | packet.encrypted
        context = Context(placed.position, source.epoch, steady, flags, now)
        for entry in packet.entries:
            if entry.topic_id >= len(self.registry):
                self.stats.dropped["unknown_topic"] += 1
                continue
            topic = source.topics.get(entry.topic_id)
            if topic is None:
                topic = source.topics[entry.topic_id] = TopicReassembler(entry.topic_id)
            missed = topic.missed_ids
            result, ended = topic.accept(entry, context)
            self.stats.message_loss_est += topic.missed_ids - missed
            events += [self._forget(partial, packet.src_id, "lost_fragments") for partial in ended]
            if isinstance(result, Partial):
                grown = result.add(entry, now)
                source.size += grown
                self._size += grown
                self._partials[result] = packet.src_id
                self._partials.move_to_end(result)
                if not result.complete:
                    continue
                self._release(result)
                result = result.payload()
            events += self._deliver(source, packet, entry.topic_id, entry.entry_id, result)
        source.epoch += placed.arrival is Arrival.LATE
        events += self._bound(source, packet.src_id)
        return events

    def _deliver(
        self, source: _Source, packet: Packet, topic_id: int, entry_id: int, payload: bytes
    ) -> Iterable[ReceiverEvent]:
        if packet.encrypted or (packet.compressed and self._codec is None):
            return [self._undone(packet, topic_id, entry_id, "unsupported")]
        if packet.compressed and self._codec is not None:
            try:
                payload = self._codec.decode(topic_id, payload)
            except CodecError as error:
                return [self._undone(packet, topic_id, entry_id, error.row)]
        if self.registry[topic_id].latched:
            if source.latched.get(topic_id) == payload:
                self.stats.repeats += 1
                return []
            source.latched[topic_id] = payload
        self.stats.delivered[packet.src_id, topic_id] += 1
        return [Delivered(packet.src_id, topic_id, payload, packet.qos, entry_id)]

    def _undone(self, packet: Packet, topic_id: int, entry_id: int, row: str) -> Lost:
        """Book a message that came whole, but cannot be read here."""
        self.stats.lost[packet.src_id, topic_id, row] += 1
        return Lost(packet.src_id, topic_id, row, entry_id)

    def _bound(self, source: _Source, src_id: int) -> list[ReceiverEvent]:
        """Give up the oldest incomplete messages where memory is over its bounds."""
        events: list[ReceiverEvent] = []
        while source.size > self.config.max_source_bytes:
            oldest = next(partial for partial, owner in self._partials.items() if owner == src_id)
            events.append(self._abandon(oldest, "memory"))
        while self._size > self.config.max_bytes:
            events.append(self._abandon(next(iter(self._partials)), "memory"))
        return events

    def _abandon(self, partial: Partial, reason: str) -> Lost:
        """Give up a message its topic still holds."""
        src_id = self._partials[partial]
        del self._sources[src_id].topics[partial.topic_id].partials[partial.entry_id]
        return self._forget(partial, src_id, reason)

    def _forget(self, partial: Partial, src_id: int, reason: str) -> Lost:
        """Book a message its topic no longer holds as lost."""
        source = self._sources[src_id]
        source.size -= partial.size
        self._size -= partial.size
        del self._partials[partial]
        self.stats.lost[src_id, partial.topic_id, reason] += 1
        self.stats.message_loss_est += 1
        return Lost(src_id, partial.topic_id, reason, partial.entry_id)

    def _release(self, partial: Partial) -> None:
        """Free the memory of a message that completed."""
        source = self._sources[self._partials.pop(partial)]
        source.size -= partial.size
        self._size -= partial.size
        del source.topics[partial.topic_id].partials[partial.entry_id]

    def _report(self, events: list[ReceiverEvent], more: Iterable[ReceiverEvent]) -> list[ReceiverEvent]:
        for event in more:
            events.append(event)
            if self._observer is not None:
                self._observer(event)
        return events
