"""What an endpoint of version 1 tells its shell: values only, no behaviour.

A message's ``key`` names it on the air among all messages of its sender: boot number, number of the packet in which it
began, and its place among that packet's entries. Whoever joins both ends' books compares keys and asks nothing of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

from gr_ros2.errors import WireError
from gr_ros2.wire.table import Row


class Key(NamedTuple):
    """A message of one sender."""

    boot: int
    number: int
    place: int


AirKind = Literal["new", "repair", "report", "hello"]
"""What a packet's airtime was spent on; ``hello`` includes requests."""


@dataclass(frozen=True, slots=True)
class Accepted:
    """A message was submitted. ``serial`` counts those of this sender from 0.

    ``expected``: what is to come out at the far end, where the link's codec changes the message on purpose.
    """

    serial: int
    topic_id: int
    payload: bytes
    now: float
    expected: bytes | None = None


@dataclass(frozen=True, slots=True)
class Refused:
    """A submitted message will not be sent, or not to its end; ``reason`` is a ledger row (see ``link.queues``)."""

    serial: int
    topic_id: int
    reason: str
    detail: str = ""


@dataclass(frozen=True, slots=True)
class SentPart:
    """One entry of a packet that left. ``repeat``: for robots that come late."""

    serial: int
    topic_id: int
    key: Key
    offset: int
    length: int
    last: bool
    repeat: bool


@dataclass(frozen=True, slots=True)
class SentPacket:
    """A packet left; ``parts`` of one that has not been sent before."""

    data: bytes
    kind: AirKind
    parts: tuple[SentPart, ...]
    now: float


@dataclass(frozen=True, slots=True)
class Delivered:
    """A message is here, in order. ``repaired``: not all of its packets came the first time."""

    src_id: int
    topic_id: int
    payload: bytes
    qos: int
    key: Key
    repaired: bool


@dataclass(frozen=True, slots=True)
class Lost:
    """A message of which something came will not be delivered.

    ``reason`` is a ledger row: ``given_up`` (not repaired in time), ``overtaken`` (a newer one was delivered first),
    ``expired`` (no fragment for ``reassembly_timeout_s``), ``memory``, ``unknown_topic`` (no table tells of its topic),
    ``restarted`` (its sender did), or what the codec says of it.
    """

    src_id: int
    topic_id: int
    reason: str
    key: Key


@dataclass(frozen=True, slots=True)
class Rejected:
    """Bytes from the PHY that are no packet of ours, or of nobody that can be trusted."""

    error: WireError


@dataclass(frozen=True, slots=True)
class Met:
    """A robot is heard, for the first time or after a restart."""

    src_id: int
    boot: int
    hears: bool


@dataclass(frozen=True, slots=True)
class Gone:
    """A robot has not been heard for ``give_up_s``."""

    src_id: int
    boot: int


@dataclass(frozen=True, slots=True)
class Announced:
    """A robot's table of topics is here; its messages follow."""

    src_id: int
    rows: tuple[Row, ...]


Event = Accepted | Refused | SentPacket | Delivered | Lost | Rejected | Met | Gone | Announced
