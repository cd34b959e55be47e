"""The interface of every version of the wire format, and what all of them share: constants, counters that wrap around.

Invariants: a format object has no state; sizes are in bytes; a size that a scheduler asks for is exact or too small,
never too large.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

BROADCAST = 255
"""Destination id of a packet for everybody; source ids are below it."""

QOS_DEFAULT, QOS_LATENCY, QOS_BULK = 0, 1, 2
QOS_NAMES = ("default", "latency", "bulk")
"""QoS classes by their code."""


class Entry(Protocol):
    """A message, or a part of one, in a packet."""

    @property
    def topic_id(self) -> int:
        """Registry row."""

    @property
    def payload(self) -> bytes:
        """Bytes of the message."""

    @property
    def name(self) -> int:
        """Number of the message on the wire, unique among the messages of its source and topic."""

    @property
    def label(self) -> str:
        """Which message, and which part of it, in a few characters."""

    def describe(self) -> str:
        """The same as ``label``, in words."""


class Packet(Protocol):
    """A packet as a value: the fields that tools can read in every version."""

    @property
    def version(self) -> int:
        """Value of the first four bits, 0 or 1."""

    @property
    def src_id(self) -> int:
        """Id of the sender, 0..254."""

    @property
    def dst_id(self) -> int:
        """Id of the robot that it is for, BROADCAST = everybody."""

    @property
    def seq(self) -> int:
        """Number on the wire, ``Format.number_bits`` wide."""

    @property
    def numbered(self) -> bool:
        """Whether it has a number of its own; otherwise it has that of the newest packet of its source."""

    @property
    def qos(self) -> int:
        """QoS class of its messages, a place in QOS_NAMES."""

    @property
    def hop(self) -> int:
        """Hop count, 0..15 in version 0, 0..255 in version 1."""

    @property
    def compressed(self) -> bool:
        """Whether a message in it is coded."""

    @property
    def encrypted(self) -> bool:
        """Whether its body is encrypted."""

    @property
    def entries(self) -> Sequence[Entry]:
        """Messages and fragments, in their order."""


class Span(NamedTuple):
    """A range of a packet's bytes.

    :param kind: head, ids, entry, control, repair, pad or crc (or the tag in its place)
    :param size: bytes, with an entry's own header included
    :param entry: the entry, if the range is one
    """

    kind: str
    size: int
    entry: Entry | None = None


class Format(Protocol):
    """One version of the wire format: its limits, its arithmetic, and reading a packet."""

    @property
    def version(self) -> int:
        """Value of the first four bits of a packet."""

    @property
    def number_bits(self) -> int:
        """Width of packet numbers, bits."""

    @property
    def max_topics(self) -> int:
        """Topic ids are below this number."""

    @property
    def min_packet_len(self) -> int:
        """Shortest ``packet_len`` of a link."""

    @property
    def max_packet_len(self) -> int:
        """Longest ``packet_len`` of a link."""

    def largest_message(self, packet_len: int) -> int:
        """Most bytes of a message."""

    def single_entry_payload(self, packet_len: int) -> int:
        """Most payload bytes of a packet with one entry."""

    def packed_len(self, payload_lens: Sequence[int]) -> int:
        """Bytes of a packet with entries of these payload lengths, without padding."""

    def layout(self, packet: Any, packet_len: int, size: int | None = None) -> list[Span]:
        """The fields of a packet, in the order of its bytes.

        :param packet_len: bytes of the longest packet on this link
        :param size: bytes of this packet, None = as many
        """

    def decode(self, data: bytes, packet_len: int) -> Packet:
        """The packet in these bytes.

        :raises WireError: they are not a packet of this version
        """


def unwrap(low: int, least: int, bits: int) -> int:
    """The smallest number, not below ``least``, with the lowest bits that the wire carries.

    A counter may be up to ``n`` behind the newest number seen; then ``least = newest - n``. Numbers up to
    ``2**bits - 1 - n`` ahead of the newest are then told apart from numbers behind it.

    :param low: as received, 0..2**bits - 1
    :param bits: width on the wire
    :return: ``least`` .. ``least + 2**bits - 1``
    """
    return least + (low - least & (1 << bits) - 1)


def varint(value: int) -> bytes:
    """Seven bits per byte, the lowest first; the top bit says that more bytes follow."""
    if value < 128:
        return bytes((value,))
    if value < 1 << 14:
        return bytes((value & 127 | 128, value >> 7))
    parts = bytearray()
    while value > 127:
        parts.append(value & 127 | 128)
        value >>= 7
    parts.append(value)
    return bytes(parts)
