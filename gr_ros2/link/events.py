"""The events that the engines report: values only, no behaviour.

A message is named by its source, its topic and a ``key``: a hashable value that the engine makes and only compares. A
key may be used again, but never while the earlier message with this key can still arrive.

Events are named tuples because several are made per packet: a frozen dataclass takes three times as long to make. Where
a field hides a method of tuples that nobody calls on an event, ``type: ignore`` says so.
"""

from __future__ import annotations

from collections.abc import Hashable
from typing import Literal, NamedTuple

from gr_ros2.core.errors import WireError
from gr_ros2.wire import AnnouncedTopic, Packet


class PacketId(NamedTuple):
    """What a packet is named by, at its sender and at every receiver, whatever its bytes.

    :param boot: number of the sender's start; 0 with version 0, which has none
    :param number: full number of the packet; with version 0 the number on the wire, which comes round
    :param repair_id: tells packets apart that have one number: a packet of messages and its repairs; with version 0,
        whose numbers come round, a checksum of its bytes
    """

    src_id: int
    boot: int
    number: int
    repair_id: int


class AirPacket(NamedTuple):
    """A packet on its way to or from the air. Times are s on the clock of the link: live the machine's monotonic one.

    :param at: when its burst begins or began; None where the PHY does not say
    :param leave_at: when its burst has to begin; None for as soon as possible
    :param mcs: with an adaptive rate the MCS that it is sent with; None for a fixed rate
    :param snr_db: SNR of its burst, dB; None where it is not measured
    """

    data: bytes
    at: float | None = None
    leave_at: float | None = None
    mcs: int | None = None
    snr_db: float | None = None


APART = 256
"""Between the topic ids of two endpoints of a robot, as observers see them: the one that has all radios and those that
have one alone."""


class BoundPacket(NamedTuple):
    """A packet of an endpoint that has one radio of its robot alone left or came: its bytes on the air, and when, s.

    Other observers than a capture know packets by their numbers, which are those of the endpoint with all radios.
    """

    data: bytes
    now: float


class Received(NamedTuple):
    """A packet arrived: its bytes, their meaning, and the fields of its name. Events that it causes follow it.

    :param received_at, snr_db: ``at`` and ``snr_db`` of its :class:`AirPacket`
    """

    data: bytes
    packet: Packet
    src_id: int
    boot: int
    number: int
    repair_id: int
    received_at: float | None = None
    snr_db: float | None = None

    @property
    def identity(self) -> PacketId:
        """Its name. It is made when somebody asks: a value more for each packet costs an endpoint 1 %."""
        return PacketId(self.src_id, self.boot, self.number, self.repair_id)


class Rejected(NamedTuple):
    """Bytes from the PHY that are not a valid packet."""

    data: bytes
    error: WireError


class Delivered(NamedTuple):
    """A message is complete. ``qos`` is the class of the packet that completed it; ``repaired``: at least one of its
    packets was lost at first and recovered later; ``hops``: robots that have sent it on, and ``over``: the last of
    them, None where there were none; ``age_s``: s for which it has been under way at least; ``shown``: the message
    that was published, where a frame was decoded for it (:mod:`gr_ros2.link.frames`), None: the payload;
    ``latency_s``: s from its stamp to its publication, None where it has no stamp, or the clock of its sender is not
    known; ``again``: it came out before, and was sent once more for another robot."""

    src_id: int
    topic_id: int
    payload: bytes
    qos: int
    key: Hashable = None
    repaired: bool = False
    hops: int = 0
    over: int | None = None
    age_s: float = 0.0
    shown: bytes | None = None
    latency_s: float | None = None
    again: bool = False

    @property
    def message(self) -> bytes:
        """What was published."""
        return self.payload if self.shown is None else self.shown


class Lost(NamedTuple):
    """A message will not be delivered, although at least a part of it arrived.

    ``reason`` is a :class:`gr_ros2.link.fates.Fate`: ``lost_fragments`` (overtaken, contradicted, or after
    an outage), ``expired`` (reassembly_timeout_s), ``memory`` (the oldest, when memory ran out), ``unsupported`` (C or
    E), ``given_up`` (not repaired in time), ``overtaken`` (a newer one was delivered before), ``unknown_topic`` (its
    topic is not announced or registered), ``sender_restarted``. If the message is complete but cannot be decoded, the
    reason is that of its codec: ``unknown_dictionary`` or ``damaged``.
    """

    src_id: int
    topic_id: int
    reason: str
    key: Hashable = None


class Met(NamedTuple):
    """A robot is heard for the first time or again.

    ``boot`` counts its starts; ``hears``: it reports what it hears.
    """

    src_id: int
    boot: int
    hears: bool


class Gone(NamedTuple):
    """A robot has been silent for a long time."""

    src_id: int
    boot: int


class Announced(NamedTuple):
    """A robot's table of topics has arrived. It gives the meaning of the topic ids of the following messages."""

    src_id: int
    topics: tuple[AnnouncedTopic, ...]


ReceiverEvent = Received | Rejected | Delivered | Lost | Met | Gone | Announced | BoundPacket


class Accepted(NamedTuple):
    """A message was submitted. ``serial`` counts the submitted messages of this sender from 0.

    ``expected`` is the payload that the other end should publish, where the link's codec changes the message on purpose
    (alignment gaps, quantised fields); None: the payload itself.
    """

    serial: int
    topic_id: int
    payload: bytes
    now: float
    expected: bytes | None = None


class Refused(NamedTuple):
    """A submitted message will not be sent, or not completely.

    ``reason`` is a fate too: ``too_large``, ``queue_bound``, ``superseded``, ``stale``, ``cannot_complete``, or
    ``abandoned`` for a message whose first fragments have left.
    """

    serial: int
    topic_id: int
    reason: str
    detail: str = ""


class Missed(NamedTuple):
    """Messages of a topic that the source's ROS graph lost before they were submitted, as far as the graph reports
    them.

    They have the fate ``lost_on_graph``. Nothing but their number is known: they have no serial and no time.
    """

    topic_id: int
    count: int  # type: ignore[assignment]


class Ended(NamedTuple):
    """What is known of a message for one robot that was sent where messages are relayed.

    ``arrived``: that robot has told that it has the message. Otherwise it has told nothing, and the message is of no
    more use: it is kept no longer. What became of it is known there only.
    """

    serial: int
    topic_id: int
    dst_id: int
    arrived: bool


class SentEntry(NamedTuple):
    """One entry of a packet that left: fragment ``index`` of message ``serial``.

    ``total`` is the number of fragments of the message; 0 where the number is not fixed in advance. ``repeat`` says
    that the message was sent before, and is sent again for robots that join late.
    """

    serial: int
    topic_id: int
    key: Hashable
    index: int  # type: ignore[assignment]
    total: int
    repeat: bool = False


AirKind = Literal["new", "repair", "report", "hello"]
"""What a packet's airtime was used for: messages; repair of what may have been lost; reports of what was heard; hellos,
requests, and questions that try out the link."""


class SentPacket(NamedTuple):
    """A packet that left the sender: its bytes, their meaning, the fields of its name, and the messages to which its
    entries belong, in order.

    ``entries`` are those of messages that are sent for the first time; a repair has none. ``mcs`` is that of the
    adaptive rate (:mod:`gr_ros2.link.rate`), 0 where the rate is fixed. ``leave_at`` is the time in s, on the clock of
    ``now``, at which its burst is to begin; None: as soon as the PHY can send it.
    """

    data: bytes
    packet: Packet
    src_id: int
    boot: int
    number: int
    repair_id: int
    entries: tuple[SentEntry, ...]
    now: float
    kind: AirKind = "new"
    mcs: int = 0
    leave_at: float | None = None

    @property
    def identity(self) -> PacketId:
        """Its name, see :class:`Received`."""
        return PacketId(self.src_id, self.boot, self.number, self.repair_id)


SenderEvent = Accepted | Refused | Missed | Ended | SentPacket | BoundPacket
