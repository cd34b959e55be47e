"""The events that the engines report: values only, no behaviour.

A message is named by its source, its topic and a ``key``: a hashable value that the engine makes and only compares. A
key may be used again, but never while the earlier message with this key can still arrive.
"""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass

from gr_ros2.errors import WireError
from gr_ros2.wire import Packet


@dataclass(frozen=True, slots=True)
class Received:
    """A packet arrived: its bytes and their meaning. Events that it causes follow it."""

    data: bytes
    packet: Packet


@dataclass(frozen=True, slots=True)
class Rejected:
    """Bytes from the PHY that are no packet of ours."""

    data: bytes
    error: WireError


@dataclass(frozen=True, slots=True)
class Delivered:
    """A message is complete. ``qos`` is the class of the packet that completed it."""

    src_id: int
    topic_id: int
    payload: bytes
    qos: int
    key: Hashable = None


@dataclass(frozen=True, slots=True)
class Lost:
    """A message of which at least one fragment arrived will never be complete.

    ``reason`` is a :class:`gr_ros2.link.ledger_rows.LedgerRow`: ``lost_fragments`` (overtaken, contradicted, or behind
    an outage), ``expired`` (reassembly_timeout_s), ``memory`` (the oldest, when memory ran out), ``unsupported`` (C or
    E); or the message is complete and its codec reports ``unknown_dictionary`` or ``damaged``.
    """

    src_id: int
    topic_id: int
    reason: str
    key: Hashable = None


ReceiverEvent = Received | Rejected | Delivered | Lost


@dataclass(frozen=True, slots=True)
class Accepted:
    """A message was submitted. ``serial`` counts the submitted messages of this sender from 0.

    ``expected`` is the payload that the other end should publish, where the link's codec changes the message on purpose
    (alignment gaps, quantised fields); None: the payload itself.
    """

    serial: int
    topic_id: int
    payload: bytes
    now: float
    expected: bytes | None = None


@dataclass(frozen=True, slots=True)
class Refused:
    """A submitted message will not be sent, or not completely.

    ``reason`` is a row too: ``too_large``, ``queue_bound``, ``superseded``, ``stale``, ``cannot_complete``, or, of
    a message whose first fragments have left, ``abandoned``.
    """

    serial: int
    topic_id: int
    reason: str
    detail: str = ""


@dataclass(frozen=True, slots=True)
class Missed:
    """Messages of a topic that the source's ROS graph lost before they were submitted, as far as the graph reports
    them.

    They end in the ledger row ``lost_on_graph``. Nothing but their number is known: they have no serial and no time.
    """

    topic_id: int
    count: int


@dataclass(frozen=True, slots=True)
class SentEntry:
    """One entry of a packet that left: fragment ``index`` of message ``serial``.

    ``total`` is the number of fragments of the message; 0 where the number is not fixed in advance. ``repeat`` says
    that the message was sent before, and is sent again for robots that join late.
    """

    serial: int
    topic_id: int
    key: Hashable
    index: int
    total: int
    repeat: bool = False


@dataclass(frozen=True, slots=True)
class SentPacket:
    """A packet left the sender: its bytes, their meaning, and the messages of its entries, in order."""

    data: bytes
    packet: Packet
    entries: tuple[SentEntry, ...]
    now: float


SenderEvent = Accepted | Refused | Missed | SentPacket
