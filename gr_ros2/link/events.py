"""What the engines tell their shells: values only, no behaviour.

A message is named by its source, its topic and a ``key``: a hashable value that the engine makes and only compares. A
key may come round, but never while the message that had it before can still arrive.
"""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass

from gr_ros2.errors import WireError
from gr_ros2.wire import Packet


@dataclass(frozen=True, slots=True)
class Received:
    """A packet came in: its bytes and what they say. What it completes or ends is told behind it."""

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
    """A message of which at least one fragment came will never be complete.

    ``reason`` is a :class:`gr_ros2.link.ledger_rows.LedgerRow`: ``lost_fragments`` (overtaken, contradicted, or behind
    an outage), ``expired`` (reassembly_timeout), ``memory`` (the oldest, when memory ran out), ``unsupported`` (C or
    E); or it is complete and its codec says ``unknown_dictionary`` or ``damaged``.
    """

    src_id: int
    topic_id: int
    reason: str
    key: Hashable = None


ReceiverEvent = Received | Rejected | Delivered | Lost


@dataclass(frozen=True, slots=True)
class Accepted:
    """A message was submitted. ``serial`` counts the submitted messages of this sender from 0.

    ``expected`` is what is to come out at the far end, where the link's codec changes the message on purpose (alignment
    gaps, quantised fields); None: the payload itself.
    """

    serial: int
    topic_id: int
    payload: bytes
    now: float
    expected: bytes | None = None


@dataclass(frozen=True, slots=True)
class Refused:
    """A submitted message will not be sent, or not to its end.

    ``reason`` is a row too: ``too_large``, ``queue_bound``, ``superseded``, ``stale``, ``cannot_complete``, or, of
    a message whose first fragments have left, ``abandoned``.
    """

    serial: int
    topic_id: int
    reason: str
    detail: str = ""


@dataclass(frozen=True, slots=True)
class Missed:
    """Messages of a topic that the source's ROS graph lost before they were submitted, as far as it tells.

    They end in the ledger row ``lost_on_graph``. Nothing but their number is known: they have no serial and no time.
    """

    topic_id: int
    count: int


@dataclass(frozen=True, slots=True)
class SentEntry:
    """One entry of a packet that left: fragment ``index`` of message ``serial``.

    ``total`` fragments are all of it; 0 while a message is cut as it goes. ``repeat`` says that the message has been
    sent before, and is sent again for robots that come late.
    """

    serial: int
    topic_id: int
    key: Hashable
    index: int
    total: int
    repeat: bool = False


@dataclass(frozen=True, slots=True)
class SentPacket:
    """A packet that left the sender: its bytes, what they say, and of which messages its entries are, in order."""

    data: bytes
    packet: Packet
    entries: tuple[SentEntry, ...]
    now: float


SenderEvent = Accepted | Refused | Missed | SentPacket
