"""The loss ledger joins the reports of both ends of a link, so that every sent message has exactly one fate.

Invariants: the fates of a topic always add up to the number of messages sent on it; a message counts as delivered once,
and only when a delivery with exactly its bytes was seen (the bytes that the link's codec must return: gaps zero, fields
quantised); a repeat counts neither as sent nor as delivered, unless it delivers the message that it repeats; payload
digests are kept only for messages whose result is open; each message takes about 33 bytes in addition.

Events must be reported in causal order: the contents of a packet before its reception, and the reception of a packet
(:meth:`Ledger.packet_received`) before the receiver events that result from it. Several threads may report events.
"""

from __future__ import annotations

from array import array
from collections import Counter, deque
from dataclasses import dataclass, field
from math import isnan, nan
from threading import Lock
from typing import get_args

from gr_ros2.core.errors import RunError
from gr_ros2.link.events import (
    Accepted,
    AirKind,
    Delivered,
    Lost,
    Missed,
    PacketId,
    ReceiverEvent,
    Refused,
    Rejected,
    SenderEvent,
    SentEntry,
    SentPacket,
)
from gr_ros2.link.fates import Fate, arrived
from gr_ros2.link.tracker import Tracked, Tracker, digest_of

_OPEN = 255

REORDER_WINDOW = 1024
"""A packet that is this many packets older than the newest received packet will not arrive any more."""


@dataclass(slots=True)
class TopicLedger:
    """The results of one topic of one source. The arrays are parallel, with one item per message handed to the source,
    in the order of submission.

    :param sent: messages for this link: handed to the source, or lost before by its ROS graph; repeats excluded
    :param corrupt: deliveries that match no message; a number above 0 indicates a serious fault
    :param repeats_delivered: deliveries of repeats whose message already had its fate
    :param fates: fate -> messages
    :param t_sent: s, time of submission; NaN for a message refused before it was queued
    :param t_delivered: s, time of delivery; NaN where it was not delivered
    :param hops: how many robots sent it on; -1 where it was not delivered
    :param size: serialized bytes; 0 where refused before it was queued
    :param serial: the sender's number of the message
    :param fate: its fate, as its index in ``list(codes)``; _OPEN while its result is open
    :param codes: fate -> its code in ``fate``
    """

    src_id: int
    topic_id: int
    sent: int = 0
    corrupt: int = 0
    repeats_delivered: int = 0
    fates: Counter[str] = field(default_factory=Counter)
    t_sent: array[float] = field(default_factory=lambda: array("d"))
    t_delivered: array[float] = field(default_factory=lambda: array("d"))
    hops: array[int] = field(default_factory=lambda: array("b"))
    size: array[int] = field(default_factory=lambda: array("L"))
    serial: array[int] = field(default_factory=lambda: array("q"))
    fate: array[int] = field(default_factory=lambda: array("B"))
    codes: dict[str, int] = field(default_factory=dict)

    def book(self, position: int, fate: str) -> None:
        """Enter the fate of the message at this position of the arrays."""
        name = str(fate)
        self.fates[name] += 1
        self.fate[position] = self.codes.setdefault(name, len(self.codes))


@dataclass(slots=True, eq=False)
class _OpenMessage(Tracked):
    """A message whose result is open.

    :ivar position: its index in the topic's arrays
    :ivar received: number of its fragments that were received
    :ivar last_packet: number of the last packet with one of its fragments
    """

    position: int = -1
    received: int = 0
    last_packet: int = -1
    reason: str = ""


@dataclass(slots=True)
class _SourceBook:
    """One sender: its open messages, and its packets in the air."""

    src_id: int
    messages: Tracker[_OpenMessage] = field(default_factory=Tracker)
    closed_serials: int = 0
    seen: set[int] = field(default_factory=set)
    packets_sent: int = 0
    air: Counter[str] = field(default_factory=Counter)
    last_received: int = -1
    in_air: deque[tuple[int, PacketId]] = field(default_factory=deque)
    waiting: dict[PacketId, deque[tuple[int, tuple[SentEntry, ...]]]] = field(default_factory=dict)


class Ledger:
    """Joins the reports of the senders and of the receiver of one link."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._topics: dict[tuple[int, int], TopicLedger] = {}
        self._sources: dict[int, _SourceBook] = {}
        self._unmatched: list[tuple[Delivered, float]] = []
        """Deliveries without a message so far, with the digest in place of the payload."""
        self._faults: list[str] = []
        self._finished = False
        self._received = 0
        self._rejected: Counter[str] = Counter()

    # -- feeding ------------------------------------------------------------------------------------------------

    def sender_event(self, src_id: int, event: SenderEvent) -> None:
        with self._lock:
            if self._finished:
                return
            source = self._sources.get(src_id)
            if source is None:
                source = self._sources[src_id] = _SourceBook(src_id)
            if isinstance(event, SentPacket):
                self._sent(source, event)
            elif isinstance(event, Accepted):
                self._accepted(source, event)
            elif isinstance(event, Missed):
                topic = self._topic(src_id, event.topic_id)
                topic.sent += event.count
                topic.fates[Fate.LOST_ON_GRAPH.value] += event.count
            elif isinstance(event, Refused):
                self._refused(source, event)

    def packet_received(self, identity: PacketId) -> int | None:
        """Take a packet that the sink has opened.

        :return: its number, from 0 per source; None if no such packet was sent
        """
        with self._lock:
            if self._finished:
                return None
            self._received += 1
            source = self._sources.get(identity.src_id)
            return None if source is None or identity not in source.waiting else _arrived(source, identity)

    def receiver_event(self, event: ReceiverEvent, now: float) -> float | None:
        """Take an event of the receiver.

        :param now: s, on the clock of the sender's events; for a delivery: when the message was republished
        :return: s, when the delivered message was submitted; None for other events, and where the message is not known
        """
        with self._lock:
            if self._finished:
                return None
            if isinstance(event, Delivered):
                return self._delivered(event, now)
            if isinstance(event, Lost):
                self._lost(event)
            elif isinstance(event, Rejected):
                self._rejected[event.error.kind] += 1
        return None

    def finish(self, drained: bool = False) -> list[TopicLedger]:
        """Close the ledger. Later reports of the run's threads are ignored.

        :param drained: nothing is left in the PHY, so packets that were sent and have not arrived are lost
        :return: one ledger per source and topic that occurred, in the order of source and topic id
        :raises RunError: when the events contradict each other, or fates do not add up
        """
        with self._lock:
            if not self._finished:
                self._finished = True
                self._match_late()
                for source in self._sources.values():
                    for message in list(source.messages.open):
                        self._close(source, message, _final_fate(source, message, drained))
            self._check()
            return [self._topics[key] for key in sorted(self._topics)]

    def packets(self) -> dict[str, int]:
        """Packet counts: ``sent``; ``received`` (decoded by the sink); ``crc_failed``; ``malformed`` (every other
        refusal of the decoder); and each refusal by its own name as ``rejected_<kind>``. If some packets did not carry
        new messages, also ``air_<kind>`` for each of :data:`gr_ros2.link.events.AirKind`."""
        with self._lock:
            crc_failed = self._rejected["crc"]
            air = sum((source.air for source in self._sources.values()), Counter[str]())
            kinds = {f"air_{kind}": air[kind] for kind in get_args(AirKind)}
            return {
                "sent": sum(source.packets_sent for source in self._sources.values()),
                "received": self._received,
                "crc_failed": crc_failed,
                "malformed": self._rejected.total() - crc_failed,
                **{f"rejected_{kind}": count for kind, count in sorted(self._rejected.items())},
                **(kinds if air.total() > air["new"] else {}),
            }

    def totals(self) -> tuple[int, int]:
        """Messages sent and delivered so far."""
        with self._lock:
            topics = self._topics.values()
            return sum(topic.sent for topic in topics), sum(arrived(topic.fates) for topic in topics)

    def fates(self) -> dict[tuple[int, int], Counter[str]]:
        """The fates of all messages sent so far, by source and topic id, as if the ledger were closed now. Packets that
        have not arrived count as still in the PHY. The fates add up to the number of messages sent."""
        with self._lock:
            fates = {key: Counter(topic.fates) for key, topic in self._topics.items()}
            for source in self._sources.values():
                for message in source.messages.open:
                    fates[source.src_id, message.topic_id][str(_final_fate(source, message, drained=False))] += 1
            return fates

    def unresolved(self) -> int:
        """Messages accepted by the senders whose result is open: not delivered, not refused and not given up."""
        with self._lock:
            return sum(not message.reason for source in self._sources.values() for message in source.messages.open)

    # -- sender -------------------------------------------------------------------------------------------------

    def _new_message(self, source: _SourceBook, event: Accepted | Refused, t: float, size: int) -> TopicLedger:
        serial = event.serial
        if serial < source.closed_serials or serial in source.seen:
            self._faults.append(f"source {source.src_id}: serial {serial} was reported twice")
        source.seen.add(serial)
        while source.closed_serials in source.seen:  # serials come nearly in order: the set stays small
            source.seen.remove(source.closed_serials)
            source.closed_serials += 1
        topic = self._topic(source.src_id, event.topic_id)
        topic.sent += 1
        topic.t_sent.append(t)
        topic.t_delivered.append(nan)
        topic.hops.append(-1)
        topic.size.append(size)
        topic.serial.append(serial)
        topic.fate.append(_OPEN)
        return topic

    def _accepted(self, source: _SourceBook, event: Accepted) -> None:
        topic = self._new_message(source, event, event.now, len(event.payload))
        message = _OpenMessage.of(event)
        message.position = len(topic.serial) - 1
        source.messages.add(message)

    def _refused(self, source: _SourceBook, event: Refused) -> None:
        message = source.messages.get(event.serial)
        if message is None:  # refused before it was queued
            topic = self._new_message(source, event, nan, 0)
            topic.book(len(topic.serial) - 1, event.reason)
        else:
            self._close(source, message, event.reason)

    def _sent(self, source: _SourceBook, event: SentPacket) -> None:
        ordinal = source.packets_sent
        source.packets_sent += 1
        source.air[event.kind] += 1
        for entry in event.entries:
            message = source.messages.left(entry)
            if message is not None:
                message.last_packet = ordinal
                if message.sent == 1:
                    self._retire(source, message)
        identity = event.identity
        source.in_air.append((ordinal, identity))
        source.waiting.setdefault(identity, deque()).append((ordinal, event.entries))

    def _retire(self, source: _SourceBook, newer: _OpenMessage) -> None:
        """Close older messages with the same key that cannot arrive any more. Keys are reused after a while."""
        assert newer.key is not None
        horizon = source.last_received - REORDER_WINDOW
        for message in source.messages.under(*newer.key):
            if message is not newer and message.all_sent and message.last_packet < horizon:
                self._close(source, message, _final_fate(source, message, drained=False))

    # -- receiver -----------------------------------------------------------------------------------------------

    def _delivered(self, event: Delivered, now: float) -> float | None:
        source = self._sources.get(event.src_id)
        if source is not None:
            message = source.messages.find(event)
            if message is not None:
                fate = Fate.REPAIRED if event.repaired else Fate.DELIVERED
                return self._deliver(source, message, event, now, fate)
            if source.messages.repeats(event) and source.messages.repeated(event) is None:
                self._topic(event.src_id, event.topic_id).repeats_delivered += 1
                return None
        self._unmatched.append((event._replace(payload=digest_of(event.payload)), now))
        return None

    def _deliver(self, source: _SourceBook, message: _OpenMessage, event: Delivered, now: float, fate: Fate) -> float:
        topic = self._topic(source.src_id, message.topic_id)
        topic.t_delivered[message.position] = now
        topic.hops[message.position] = event.hops
        self._close(source, message, fate)
        return message.t_sent

    def _lost(self, event: Lost) -> None:
        """Store the reason. It is used unless the message is delivered after all."""
        source = self._sources.get(event.src_id)
        if source is None or source.messages.repeats(event):
            return
        candidates = [m for m in source.messages.under(event.topic_id, event.key) if not m.reason]
        seen = [m for m in candidates if m.received]  # the receiver held at least one fragment of it
        for message in (seen or candidates)[:1]:
            message.reason = event.reason

    # -- books --------------------------------------------------------------------------------------------------

    def _topic(self, src_id: int, topic_id: int) -> TopicLedger:
        key = (src_id, topic_id)
        if key not in self._topics:
            self._topics[key] = TopicLedger(src_id, topic_id)
        return self._topics[key]

    def _close(self, source: _SourceBook, message: _OpenMessage, fate: str) -> None:
        self._topic(source.src_id, message.topic_id).book(message.position, fate)
        source.messages.close(message)

    def _match_late(self) -> None:
        """Match deliveries that had no message when they came: by their bytes only, with all messages still open."""
        for event, now in self._unmatched:
            source = self._sources.get(event.src_id)
            alike = [] if source is None else source.messages.alike(event.topic_id, event.payload)
            message = next(iter(alike), None)
            if source is not None and message is not None:
                self._deliver(source, message, event, now, Fate.DELIVERED)
            else:
                self._topic(event.src_id, event.topic_id).corrupt += 1
        self._unmatched.clear()

    def _check(self) -> None:
        for topic in self._topics.values():
            name = f"source {topic.src_id}, topic {topic.topic_id}"
            delivered = sum(not isnan(t) for t in topic.t_delivered)
            submitted = topic.sent - topic.fates[Fate.LOST_ON_GRAPH.value]
            if topic.fates.total() != topic.sent or len(topic.t_sent) != submitted:
                fates = ", ".join(f"{fate} {count}" for fate, count in sorted(topic.fates.items()))
                self._faults.append(f"{name}: fates ({fates}) add up to {topic.fates.total()}, sent were {topic.sent}")
            if arrived(topic.fates) != delivered:
                self._faults.append(f"{name}: {arrived(topic.fates)} delivered, {delivered} have a delivery time")
        if self._faults:
            raise RunError(f"the loss ledger is inconsistent: {self._faults[0]} ({len(self._faults)} faults)")


def _arrived(source: _SourceBook, identity: PacketId) -> int:
    """Take the arrival of a packet of this source. A packet may be sent again, and the numbers of version 0 come round:
    it is the first with this identity that was sent after the newest received packet; if there is none, the oldest.

    :return: its number
    """
    copies = source.waiting[identity]
    ordinal, entries = next((copy for copy in copies if copy[0] > source.last_received), copies[0])
    copies.remove((ordinal, entries))
    if not copies:
        del source.waiting[identity]
    for entry in entries:
        message = source.messages.get(entry.serial)
        if message is not None and not entry.repeat:
            message.received += 1
    source.last_received = max(source.last_received, ordinal)
    while source.in_air and source.in_air[0][0] < source.last_received - REORDER_WINDOW:
        old, old_identity = source.in_air.popleft()
        rest = source.waiting.get(old_identity)
        if rest and rest[0][0] == old:
            rest.popleft()
            if not rest:
                del source.waiting[old_identity]
    return ordinal


def _final_fate(source: _SourceBook, message: _OpenMessage, drained: bool) -> str:
    """The fate of a message for which no further event came.

    It is not taken if all its packets arrived intact, but the sink neither delivered it nor gave it up (for example,
    it was not for this receiver). It is in flight if it waits at the source or in the PHY, or if its last packet is
    newer than the last packet that arrived. Otherwise it is given up where its sender repairs losses, and its fragments
    are lost where the sender does not."""
    if message.reason:
        return message.reason
    if not message.all_sent:
        return Fate.IN_FLIGHT
    if message.received >= message.total:
        return Fate.NOT_TAKEN
    if not drained and message.last_packet >= source.last_received:
        return Fate.IN_FLIGHT
    return Fate.GIVEN_UP if source.air["repair"] else Fate.LOST_FRAGMENTS
