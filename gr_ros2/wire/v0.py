"""Version 0 of the wire format, byte for byte (the paper, section 5 and table 3): packets, arithmetic, codec.

Invariants: ``decode`` raises nothing but a named WireError, whatever the bytes; ``decode(encode(p, n), n) == p`` for
every packet that ``encode`` accepts; ``encode`` writes exactly ``packet_len`` bytes; its values are immutable.
"""

from __future__ import annotations

from binascii import crc_hqx
from collections.abc import Sequence
from struct import Struct
from struct import error as struct_error
from typing import NamedTuple

from gr_ros2.core.errors import (
    CrcError,
    EncodeError,
    EntryBoundsError,
    IndexRangeError,
    LengthError,
    NoEntriesError,
    PadError,
    TotalError,
    VersionError,
)
from gr_ros2.wire.format import Span

_VERSION = 0
_HEADER_LEN = 5
_ENTRY_HEADER_LEN = 5
_CRC_LEN = 2
_MAX_ENTRIES = 15
_MAX_TOTAL = 255
_MAX_PACKET_LEN = 4095
_QOS_SHIFT = 2
_QOS_MASK = 3
_QOS_UNASSIGNED = 3
_COMPRESSED, _ENCRYPTED = 2, 1

_header = Struct(">BBBBB")
_entry_header = Struct(">BBBH")
_crc = Struct(">H")


class EntryV0(NamedTuple):
    """One fragment of one message.

    :param topic_id: registry row, 0..15
    :param entry_id: number of the message, unique among those of its source and topic, 0..255
    :param index: position of the fragment, from 0
    :param total: fragments of the message, 1..255
    :param payload: bytes of the serialized message
    """

    topic_id: int
    entry_id: int
    index: int  # type: ignore[assignment]  # hides a method of tuples that nobody calls
    total: int
    payload: bytes

    @property
    def name(self) -> int:
        """``entry_id``."""
        return self.entry_id

    @property
    def label(self) -> str:
        """``#entry_id[index/total]``."""
        return f"#{self.entry_id}[{self.index}/{self.total}]"

    def describe(self) -> str:
        return f"entry_id {self.entry_id}, index {self.index} of {self.total}"


class PacketV0(NamedTuple):
    """One packet. Its length is not stored here: it is a property of the link.

    :param src_id: 0..254 (a received one may be 255)
    :param dst_id: 0..255, 255 = broadcast
    :param seq: counter of the source, mod 256
    :param hop: hop count (TTL), 0..15
    :param entries: 1..15 fragments
    :param qos: 0 default, 1 latency, 2 bulk (3 reads as default)
    :param compressed: C bit
    :param encrypted: E bit
    """

    src_id: int
    dst_id: int
    seq: int
    hop: int
    entries: tuple[EntryV0, ...]
    version: int = _VERSION
    qos: int = 0
    compressed: bool = False
    encrypted: bool = False

    @property
    def numbered(self) -> bool:
        """Every packet has a number of its own."""
        return True


def with_crc(body: bytes) -> bytes:
    """A packet's bytes up to its CRC, and the CRC-16 of section 5.2: polynomial 0x1021, init 0, not reflected, no final
    xor."""
    return body + _crc.pack(crc_hqx(body, 0))


def without_crc(packet: bytes) -> bytes:
    """A packet's bytes up to its CRC."""
    return packet[:-_CRC_LEN]


def overhead(entries: int) -> int:
    """Bytes of a packet that belong to no entry: 7 + ceil(E/2)."""
    return _HEADER_LEN + (entries + 1) // 2 + _CRC_LEN


class FormatV0:
    """Implements :class:`gr_ros2.wire.Format`."""

    version = _VERSION
    number_bits = 8
    id_bits = 8
    max_topics = 16
    max_entries = _MAX_ENTRIES
    max_fragments = _MAX_TOTAL
    """``total`` is one byte."""
    max_packet_len = _MAX_PACKET_LEN
    min_packet_len = overhead(1) + _ENTRY_HEADER_LEN + 1
    """One entry of one byte."""

    def largest_message(self, packet_len: int) -> int:
        """Bytes of the largest message that 255 entries can carry."""
        return _MAX_TOTAL * self.single_entry_payload(packet_len)

    def smallest_packet_len(self, size: int) -> int | None:
        """Smallest packet_len that carries a message of ``size`` bytes, None if none does."""
        packet_len = self.packed_len([max(-(-size // _MAX_TOTAL), 1)])
        return packet_len if packet_len <= _MAX_PACKET_LEN else None

    def room(self, packet_len: int, entries: int, payload: int) -> int:
        """Payload bytes that one more entry may have; negative if no further entry fits."""
        if entries >= _MAX_ENTRIES:
            return -1
        count = entries + 1
        return packet_len - _HEADER_LEN - _CRC_LEN - (count + 1) // 2 - count * _ENTRY_HEADER_LEN - payload

    def single_entry_payload(self, packet_len: int) -> int:
        """Most payload bytes of a packet with one entry, k_max(1) = packet_len - 13."""
        return packet_len - overhead(1) - _ENTRY_HEADER_LEN

    def equal_entry_payload(self, packet_len: int, entries: int) -> int:
        """k*(E), most payload bytes of each of E equal entries (section 5.2); negative if E entries do not fit."""
        return (packet_len - overhead(entries)) // entries - _ENTRY_HEADER_LEN

    def packed_len(self, payload_lens: Sequence[int]) -> int:
        """Bytes of header, topic ids, entries and CRC. L_pad of section 5.3 is ``packet_len`` minus this number."""
        return overhead(len(payload_lens)) + _ENTRY_HEADER_LEN * len(payload_lens) + sum(payload_lens)

    def layout(self, packet: PacketV0, packet_len: int, size: int | None = None) -> list[Span]:  # noqa: ARG002
        """The fields of a packet, in the order of its bytes. All packets have ``packet_len`` bytes."""
        entries = packet.entries
        pad = packet_len - self.packed_len([len(entry.payload) for entry in entries])
        return [
            Span("head", _HEADER_LEN),
            Span("ids", (len(entries) + 1) // 2),
            *(Span("entry", _ENTRY_HEADER_LEN + len(entry.payload), entry) for entry in entries),
            Span("pad", pad),
            Span("crc", _CRC_LEN),
        ]

    def encode(self, packet: PacketV0, packet_len: int) -> bytes:
        """The ``packet_len`` bytes of a packet.

        :raises EncodeError: a field out of range, no or more than 15 entries, or more bytes than fit
        """
        entries = packet.entries
        count = len(entries)
        if not 1 <= count <= _MAX_ENTRIES:
            raise EncodeError(f"{count} entries; a packet has 1..{_MAX_ENTRIES}")
        if packet.version != _VERSION:
            raise EncodeError(f"version {packet.version}; this encoder writes version {_VERSION}")
        if not 0 <= packet.qos <= _QOS_MASK:
            raise EncodeError(f"qos {packet.qos} is not in 0..{_QOS_MASK}")
        if not 0 <= packet.hop <= 15:
            raise EncodeError(f"hop {packet.hop} is not in 0..15")
        if not 0 <= packet.src_id <= 254:
            raise EncodeError(f"src_id {packet.src_id} is not in 0..254")
        flags = packet.qos << _QOS_SHIFT | packet.compressed << 1 | packet.encrypted
        try:
            header = _header.pack(flags, packet.src_id, packet.dst_id, packet.seq, packet.hop << 4 | count)
            parts = [header, b""]
            topic_ids = 0
            for entry in entries:
                if not 0 <= entry.index < entry.total <= _MAX_TOTAL:
                    raise EncodeError(f"index {entry.index} of total {entry.total}; index < total <= {_MAX_TOTAL}")
                if not 0 <= entry.topic_id <= 15:
                    raise EncodeError(f"topic id {entry.topic_id} is not in 0..15")
                topic_ids = topic_ids << 4 | entry.topic_id
                parts.append(_entry_header.pack(entry.entry_id, entry.index, entry.total, len(entry.payload)))
                parts.append(entry.payload)
        except struct_error as error:
            raise EncodeError(f"a field of {packet} is out of range ({error})") from error
        parts[1] = (topic_ids << 4 * (count & 1)).to_bytes((count + 1) // 2, "big")
        body = b"".join(parts)
        room = packet_len - _CRC_LEN
        if len(body) > room:
            raise EncodeError(f"{len(body) + _CRC_LEN} bytes do not fit packet_len {packet_len}")
        body = body.ljust(room, b"\0")
        return body + _crc.pack(crc_hqx(body, 0))

    def decode(self, data: bytes, packet_len: int) -> PacketV0:
        """Read exactly ``packet_len`` bytes.

        The spare low nibble of the topic ids is ignored, and QoS 11 reads as default (0).

        :raises WireError: LengthError, CrcError, VersionError, NoEntriesError, EntryBoundsError, TotalError,
            IndexRangeError or PadError, in this order of checks
        """
        if len(data) != packet_len or packet_len < _HEADER_LEN + _CRC_LEN:
            raise LengthError(f"{len(data)} bytes where packet_len is {packet_len}")
        # The remainder over a whole intact packet, including its CRC, is 0.
        if crc_hqx(data, 0):
            raise CrcError("CRC-16 does not match")
        flags, src_id, dst_id, seq, hop_count = _header.unpack_from(data)
        if flags >> 4 != _VERSION:
            raise VersionError(f"version {flags >> 4}; this decoder reads version {_VERSION}")
        count = hop_count & 15
        if not count:
            raise NoEntriesError("entry count is 0")
        end = packet_len - _CRC_LEN
        position = overhead(count) - _CRC_LEN
        entries = []
        for number in range(count):
            start = position + _ENTRY_HEADER_LEN
            if start > end:
                raise EntryBoundsError(f"header of entry {number} runs past byte {end}")
            entry_id, index, total, length = _entry_header.unpack_from(data, position)
            position = start + length
            if position > end:
                raise EntryBoundsError(f"payload of entry {number} ({length} bytes) runs past byte {end}")
            if not total:
                raise TotalError(f"entry {number} says its message has 0 fragments")
            if index >= total:
                raise IndexRangeError(f"entry {number}: index {index} is not below total {total}")
            ids = data[_HEADER_LEN + (number >> 1)]
            topic_id = ids & 15 if number & 1 else ids >> 4
            entries.append(EntryV0(topic_id, entry_id, index, total, data[start:position]))
        if data.count(0, position, end) != end - position:
            raise PadError(f"PAD from byte {position} is not all zero")
        qos = flags >> _QOS_SHIFT & _QOS_MASK
        return PacketV0(
            src_id,
            dst_id,
            seq,
            hop_count >> 4,
            tuple(entries),
            _VERSION,
            0 if qos == _QOS_UNASSIGNED else qos,
            bool(flags & _COMPRESSED),
            bool(flags & _ENCRYPTED),
        )


V0 = FormatV0()
