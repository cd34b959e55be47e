"""What the engines tell their shells: values only, no behaviour."""

from __future__ import annotations

from dataclasses import dataclass

from gr_ros2.errors import WireError


@dataclass(frozen=True, slots=True)
class Delivered:
    """A message is complete. ``qos`` is the class of the packet that completed it; ``entry_id`` names it on the air."""

    src_id: int
    topic_id: int
    payload: bytes
    qos: int
    entry_id: int = 0


@dataclass(frozen=True, slots=True)
class Lost:
    """A message of which at least one fragment came will never be complete.

    ``reason`` is a ledger row: ``lost_fragments`` (overtaken, contradicted, or behind an outage), ``expired``
    (reassembly_timeout), ``memory`` (the oldest, when memory ran out), ``unsupported`` (C or E); or it is complete and
    its codec says ``unknown_dictionary`` or ``damaged``, or it could not be published (``publish_failed``).
    """

    src_id: int
    topic_id: int
    reason: str
    entry_id: int = 0


@dataclass(frozen=True, slots=True)
class Rejected:
    """Bytes from the PHY that are no packet of ours."""

    error: WireError


ReceiverEvent = Delivered | Lost | Rejected


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

    ``reason`` is a ledger row: ``too_large``, ``queue_bound``, ``superseded``, ``stale``, ``cannot_complete``, or, of
    a message whose first fragments have left, ``abandoned``.
    """

    serial: int
    topic_id: int
    reason: str
    detail: str = ""


LOST_ON_GRAPH = "lost_on_graph"
"""Ledger row of messages that were published for the link and lost by the ROS graph before the link had them."""


@dataclass(frozen=True, slots=True)
class Missed:
    """Messages of a topic that the source's ROS graph lost before they were submitted, as far as it tells.

    They end in the ledger row ``lost_on_graph``. Nothing but their number is known: they have no serial and no time.
    """

    topic_id: int
    count: int


@dataclass(frozen=True, slots=True)
class SentEntry:
    """One entry of a packet that left: fragment ``index`` of ``total`` of message ``serial``.

    ``repeat`` says that the message has been sent before, and is sent again for robots that come late.
    """

    serial: int
    topic_id: int
    entry_id: int
    index: int
    total: int
    repeat: bool = False


@dataclass(frozen=True, slots=True)
class SentPacket:
    """A packet that left the sender."""

    data: bytes
    entries: tuple[SentEntry, ...]
    now: float


SenderEvent = Accepted | Refused | Missed | SentPacket
