"""The loss ledger: both ends of a link joined, so that every sent message ends in exactly one row.

Laws: the rows of a topic add up to what was sent on it, always; a message counts as delivered once, and only when
a delivery with its very bytes was seen (those the link's codec is to give back: gaps zero, fields quantised); a
repeat counts neither as sent nor as delivered, unless it delivers the message that it repeats; memory holds payload
digests only of messages whose fate is open, and about 33 bytes of each message besides.

Events must come in causal order: what a packet carries is told before its reception is, and a packet's reception
(:meth:`Ledger.packet_received`) before what the receiver makes of it. The ledger may be fed from several threads.
"""

from __future__ import annotations

from array import array
from collections import Counter, deque
from dataclasses import dataclass, field
from hashlib import blake2b
from math import isnan, nan
from threading import Lock
from typing import TypeVar

from gr_ros2.errors import RunError
from gr_ros2.link.events import (
    LOST_ON_GRAPH,
    Accepted,
    Delivered,
    Lost,
    Missed,
    ReceiverEvent,
    Refused,
    Rejected,
    SenderEvent,
    SentEntry,
    SentPacket,
)

DELIVERED = "delivered"
LOST_FRAGMENTS = "lost_fragments"
NOT_TAKEN = "not_taken"
"""Every packet of the message arrived intact, yet the sink neither delivered it nor gave it up (not for us, …)."""
IN_FLIGHT = "in_flight"
"""Still in the source's queue, in the PHY, or behind the last packet that arrived."""

_OPEN = 255

REORDER_WINDOW = 1024
"""A packet this many packets older than the newest received one will not arrive any more."""


@dataclass(slots=True)
class TopicLedger:
    """What became of one topic of one source. The arrays run in parallel, one item per message handed to the source, by
    submission.

    :param sent: messages for this link: handed to the source, or lost by its ROS graph before; repeats excluded
    :param corrupt: deliveries that match no message; 0 unless something is badly wrong
    :param repeats_delivered: deliveries of repeats whose message had its row already
    :param rows: ledger row -> messages
    :param t_sent: s, time of submission; NaN for a message refused before it was queued
    :param t_delivered: s, time of delivery; NaN where it was not delivered
    :param size: serialized bytes; 0 where refused before it was queued
    :param serial: the sender's number of the message
    :param row: the ledger row it ended in, as its place in ``list(codes)``; _OPEN while its fate is open
    :param codes: ledger row -> its code in ``row``
    """

    src_id: int
    topic_id: int
    sent: int = 0
    corrupt: int = 0
    repeats_delivered: int = 0
    rows: Counter[str] = field(default_factory=Counter)
    t_sent: array[float] = field(default_factory=lambda: array("d"))
    t_delivered: array[float] = field(default_factory=lambda: array("d"))
    size: array[int] = field(default_factory=lambda: array("L"))
    serial: array[int] = field(default_factory=lambda: array("q"))
    row: array[int] = field(default_factory=lambda: array("B"))
    codes: dict[str, int] = field(default_factory=dict)

    def book(self, position: int, row: str) -> None:
        """The message at this place of the arrays ends in this row."""
        self.rows[row] += 1
        self.row[position] = self.codes.setdefault(row, len(self.codes))


@dataclass(slots=True, eq=False)
class _Open:
    """A message whose fate is open. ``position`` is its place in the topic's arrays."""

    topic: TopicLedger
    serial: int
    position: int
    digest: bytes
    entry_id: int = -1
    total: int = 0
    sent: int = 0
    received: int = 0
    last_packet: int = -1
    reason: str = ""

    @property
    def all_sent(self) -> bool:
        return self.sent >= self.total > 0


_Key = TypeVar("_Key")
_Shelf = dict[int, _Open]
"""Open messages by serial, oldest first."""


@dataclass(slots=True)
class _Source:
    """One sender: its open messages, found by serial, by entry id and by payload; and its packets in the air."""

    src_id: int
    open: _Shelf = field(default_factory=dict)
    by_entry_id: dict[tuple[int, int], _Shelf] = field(default_factory=dict)
    by_digest: dict[tuple[int, bytes], _Shelf] = field(default_factory=dict)
    repeats: dict[tuple[int, int], int] = field(default_factory=dict)
    """(topic id, entry id) whose latest use was a repeat -> serial of the message repeated."""
    closed_serials: int = 0
    seen: set[int] = field(default_factory=set)
    packets_sent: int = 0
    last_received: int = -1
    in_air: deque[tuple[int, bytes]] = field(default_factory=deque)
    waiting: dict[bytes, deque[tuple[int, tuple[SentEntry, ...]]]] = field(default_factory=dict)


class Ledger:
    """Joins what the senders and the receiver of one link report."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._topics: dict[tuple[int, int], TopicLedger] = {}
        self._sources: dict[int, _Source] = {}
        self._unmatched: list[tuple[int, int, bytes, float]] = []
        self._faults: list[str] = []
        self._finished = False
        self._packets_handed_up = 0
        self._rejected: Counter[str] = Counter()

    # -- feeding ------------------------------------------------------------------------------------------------

    def sender_event(self, src_id: int, event: SenderEvent) -> None:
        """What the sender with this source id reports."""
        with self._lock:
            if self._finished:
                return
            source = self._sources.setdefault(src_id, _Source(src_id))
            if isinstance(event, SentPacket):
                self._sent(source, event)
            elif isinstance(event, Accepted):
                self._accepted(source, event)
            elif isinstance(event, Missed):
                topic = self._topic(src_id, event.topic_id)
                topic.sent += event.count
                topic.rows[LOST_ON_GRAPH] += event.count
            else:
                self._refused(source, event)

    def packet_received(self, data: bytes) -> tuple[int, int] | None:
        """Bytes the PHY handed to the sink, whatever they are.

        :return: source and number, from 0 per source, of the packet sent with these bytes; None where none was
        """
        with self._lock:
            if self._finished:
                return None
            self._packets_handed_up += 1
            digest = _digest(data)
            for source in self._sources.values():
                if digest in source.waiting:
                    return source.src_id, _arrived(source, digest)
        return None

    def receiver_event(self, event: ReceiverEvent, now: float) -> float | None:
        """What the receiver reports.

        :param now: s, on the clock of the sender's events; of a delivery: when the message was republished
        :return: s, when the message delivered was submitted; None where there is none, or none that is known yet
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
        """Close the books. What the run's threads report later is no part of it and is ignored.

        :param drained: nothing is left in the PHY, so what was sent and has not arrived is lost
        :return: one ledger per source and topic that occurred, by source and topic id
        :raises RunError: when the events contradict each other, or rows do not add up
        """
        with self._lock:
            if not self._finished:
                self._finished = True
                self._match_late()
                for source in self._sources.values():
                    for message in list(source.open.values()):
                        self._close(source, message, _final_row(source, message, drained))
            self._check()
            return [self._topics[key] for key in sorted(self._topics)]

    def packets(self) -> dict[str, int]:
        """Packet counts: ``sent``; ``received`` (decoded by the sink); ``crc_failed``; ``malformed`` (every other
        refusal of the decoder), and each refusal by its own name as ``rejected_<kind>``."""
        with self._lock:
            crc_failed = self._rejected["crc"]
            rejected = sum(self._rejected.values())
            return {
                "sent": sum(source.packets_sent for source in self._sources.values()),
                "received": self._packets_handed_up - rejected,
                "crc_failed": crc_failed,
                "malformed": rejected - crc_failed,
                **{f"rejected_{kind}": count for kind, count in sorted(self._rejected.items())},
            }

    def totals(self) -> tuple[int, int]:
        """Messages sent and delivered so far."""
        with self._lock:
            topics = self._topics.values()
            return sum(topic.sent for topic in topics), sum(topic.rows[DELIVERED] for topic in topics)

    def rows(self) -> dict[tuple[int, int], Counter[str]]:
        """Where every message sent so far stands, by source and topic id: as if the books were closed now, with the
        PHY still holding what has not arrived. The rows add up to what was sent."""
        with self._lock:
            rows = {key: Counter(topic.rows) for key, topic in self._topics.items()}
            for source in self._sources.values():
                for message in source.open.values():
                    key = (message.topic.src_id, message.topic.topic_id)
                    rows[key][_final_row(source, message, drained=False)] += 1
            return rows

    def unresolved(self) -> int:
        """Messages accepted by the senders whose fate is open: neither delivered, refused nor given up."""
        with self._lock:
            return sum(not message.reason for source in self._sources.values() for message in source.open.values())

    # -- sender -------------------------------------------------------------------------------------------------

    def _new_message(self, source: _Source, event: Accepted | Refused, t: float, size: int) -> TopicLedger:
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
        topic.size.append(size)
        topic.serial.append(serial)
        topic.row.append(_OPEN)
        return topic

    def _accepted(self, source: _Source, event: Accepted) -> None:
        topic = self._new_message(source, event, event.now, len(event.payload))
        expected = event.payload if event.expected is None else event.expected
        message = _Open(topic, event.serial, len(topic.serial) - 1, _digest(expected))
        source.open[event.serial] = message
        source.by_digest.setdefault((event.topic_id, message.digest), {})[event.serial] = message

    def _refused(self, source: _Source, event: Refused) -> None:
        message = source.open.get(event.serial)
        if message is None:  # refused before it was queued
            topic = self._new_message(source, event, nan, 0)
            topic.book(len(topic.serial) - 1, event.reason)
        else:
            self._close(source, message, event.reason)

    def _sent(self, source: _Source, event: SentPacket) -> None:
        ordinal = source.packets_sent
        source.packets_sent += 1
        for entry in event.entries:
            key = (entry.topic_id, entry.entry_id)
            if entry.repeat:
                source.repeats[key] = entry.serial
                continue
            message = source.open.get(entry.serial)
            if message is None:  # delivered or dropped before its last fragment left
                continue
            if message.entry_id < 0:
                message.entry_id = entry.entry_id
                message.total = entry.total
                source.repeats.pop(key, None)
                self._retire(source, key)
                source.by_entry_id.setdefault(key, {})[entry.serial] = message
            message.sent += 1
            message.last_packet = ordinal
        digest = _digest(event.data)
        source.in_air.append((ordinal, digest))
        source.waiting.setdefault(digest, deque()).append((ordinal, event.entries))

    def _retire(self, source: _Source, key: tuple[int, int]) -> None:
        """Settle what had this entry id before and cannot arrive any more; 256 ids have passed since."""
        horizon = source.last_received - REORDER_WINDOW
        for message in [m for m in source.by_entry_id.get(key, {}).values() if m.all_sent and m.last_packet < horizon]:
            self._close(source, message, _final_row(source, message, drained=False))

    # -- receiver -----------------------------------------------------------------------------------------------

    def _delivered(self, event: Delivered, now: float) -> float | None:
        digest = _digest(event.payload)
        source = self._sources.get(event.src_id)
        if source is not None:
            key = (event.topic_id, event.entry_id)
            same = source.by_digest.get((event.topic_id, digest), {})
            exact = (m for m in source.by_entry_id.get(key, {}).values() if m.digest == digest)
            message = next(exact, None)
            if message is None and key in source.repeats:
                repeated = source.open.get(source.repeats[key])
                if repeated is None:
                    self._topic(event.src_id, event.topic_id).repeats_delivered += 1
                    return None
                message = repeated if repeated.digest == digest else None
            elif message is None:
                message = next((m for m in same.values() if m.sent), None)
            if message is not None:
                return self._deliver(source, message, now)
        self._unmatched.append((event.src_id, event.topic_id, digest, now))
        return None

    def _deliver(self, source: _Source, message: _Open, now: float) -> float:
        message.topic.t_delivered[message.position] = now
        self._close(source, message, DELIVERED)
        return message.topic.t_sent[message.position]

    def _lost(self, event: Lost) -> None:
        """Note the reason. It stands unless a delivery proves it wrong."""
        source = self._sources.get(event.src_id)
        if source is None or (event.topic_id, event.entry_id) in source.repeats:
            return
        shelf = source.by_entry_id.get((event.topic_id, event.entry_id), {})
        candidates = [m for m in shelf.values() if not m.reason]
        seen = [m for m in candidates if m.received]  # the receiver held at least one fragment of it
        for message in (seen or candidates)[:1]:
            message.reason = event.reason

    # -- books --------------------------------------------------------------------------------------------------

    def _topic(self, src_id: int, topic_id: int) -> TopicLedger:
        key = (src_id, topic_id)
        if key not in self._topics:
            self._topics[key] = TopicLedger(src_id, topic_id)
        return self._topics[key]

    def _close(self, source: _Source, message: _Open, row: str) -> None:
        topic_id, serial = message.topic.topic_id, message.serial
        message.topic.book(message.position, row)
        del source.open[serial]
        _take(source.by_digest, (topic_id, message.digest), serial)
        if message.entry_id >= 0:
            _take(source.by_entry_id, (topic_id, message.entry_id), serial)

    def _match_late(self) -> None:
        """Deliveries that matched nothing when they came: by their bytes alone, against all that is still open."""
        for src_id, topic_id, digest, now in self._unmatched:
            source = self._sources.get(src_id)
            shelf = source.by_digest.get((topic_id, digest), {}) if source is not None else {}
            message = next(iter(shelf.values()), None)
            if source is not None and message is not None:
                self._deliver(source, message, now)
            else:
                self._topic(src_id, topic_id).corrupt += 1
        self._unmatched.clear()

    def _check(self) -> None:
        for topic in self._topics.values():
            name = f"source {topic.src_id}, topic {topic.topic_id}"
            delivered = sum(not isnan(t) for t in topic.t_delivered)
            submitted = topic.sent - topic.rows[LOST_ON_GRAPH]
            if topic.rows.total() != topic.sent or len(topic.t_sent) != submitted:
                rows = ", ".join(f"{row} {count}" for row, count in sorted(topic.rows.items()))
                self._faults.append(f"{name}: rows ({rows}) add up to {topic.rows.total()}, sent were {topic.sent}")
            if topic.rows[DELIVERED] != delivered:
                self._faults.append(f"{name}: {topic.rows[DELIVERED]} delivered, {delivered} have a delivery time")
        if self._faults:
            raise RunError(f"the loss ledger is inconsistent: {self._faults[0]} ({len(self._faults)} faults)")


def _digest(data: bytes) -> bytes:
    return blake2b(data, digest_size=16).digest()


def _take(index: dict[_Key, _Shelf], key: _Key, serial: int) -> None:
    del index[key][serial]
    if not index[key]:
        del index[key]


def _arrived(source: _Source, digest: bytes) -> int:
    """A packet of this source came in: the first one with these bytes that was sent after the newest received.

    :return: its number
    """
    copies = source.waiting[digest]
    ordinal, entries = next((copy for copy in copies if copy[0] > source.last_received), copies[0])
    copies.remove((ordinal, entries))
    if not copies:
        del source.waiting[digest]
    for entry in entries:
        message = source.open.get(entry.serial)
        if message is not None and not entry.repeat:
            message.received += 1
    source.last_received = max(source.last_received, ordinal)
    while source.in_air and source.in_air[0][0] < source.last_received - REORDER_WINDOW:
        old, old_digest = source.in_air.popleft()
        rest = source.waiting.get(old_digest)
        if rest and rest[0][0] == old:
            rest.popleft()
            if not rest:
                del source.waiting[old_digest]
    return ordinal


def _final_row(source: _Source, message: _Open, drained: bool) -> str:
    if message.reason:
        return message.reason
    if not message.all_sent:
        return IN_FLIGHT
    if message.received >= message.total:
        return NOT_TAKEN
    return LOST_FRAGMENTS if drained or message.last_packet < source.last_received else IN_FLIGHT
