"""Version 0 on the wire, byte for byte (the paper, section 5).

Laws: ``decode`` raises nothing but a named WireError, whatever the bytes; ``decode(encode(p, n), n) == p`` for every
packet that ``encode`` takes; ``encode`` writes exactly ``packet_len`` bytes.
"""

from __future__ import annotations

from binascii import crc_hqx
from struct import Struct
from struct import error as struct_error

from gr_ros2.errors import (
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
from gr_ros2.wire.packet import CRC_LEN, ENTRY_HEADER_LEN, HEADER_LEN, MAX_ENTRIES, MAX_TOTAL, Entry, Packet, overhead

VERSION = 0
_QOS_SHIFT = 2
_QOS_MASK = 3
_QOS_UNASSIGNED = 3
_COMPRESSED, _ENCRYPTED = 2, 1

_header = Struct(">BBBBB")
_entry_header = Struct(">BBBH")
_crc = Struct(">H")


def crc16(data: bytes) -> int:
    """CRC-16 of section 5.2: polynomial 0x1021, init 0, not reflected, no final xor."""
    return crc_hqx(data, 0)


def encode(packet: Packet, packet_len: int) -> bytes:
    """The ``packet_len`` bytes of a packet.

    :raises EncodeError: a field out of range, no or more than 15 entries, or more bytes than fit
    """
    entries = packet.entries
    count = len(entries)
    if not 1 <= count <= MAX_ENTRIES:
        raise EncodeError(f"{count} entries; a packet has 1..{MAX_ENTRIES}")
    if packet.version != VERSION:
        raise EncodeError(f"version {packet.version}; this encoder writes version {VERSION}")
    if not 0 <= packet.qos <= _QOS_MASK:
        raise EncodeError(f"qos {packet.qos} is not in 0..{_QOS_MASK}")
    if not 0 <= packet.hop <= 15:
        raise EncodeError(f"hop {packet.hop} is not in 0..15")
    if not 0 <= packet.src_id <= 254:
        raise EncodeError(f"src_id {packet.src_id} is not in 0..254")
    flags = packet.qos << _QOS_SHIFT | packet.compressed << 1 | packet.encrypted
    try:
        header = _header.pack(flags, packet.src_id, packet.dst_id, packet.seq, packet.hop << 4 | count)
        parts = [header, _pack_topic_ids(entries)]
        for entry in entries:
            if not 0 <= entry.index < entry.total <= MAX_TOTAL:
                raise EncodeError(f"index {entry.index} of total {entry.total}; index < total <= {MAX_TOTAL}")
            parts.append(_entry_header.pack(entry.entry_id, entry.index, entry.total, len(entry.payload)))
            parts.append(entry.payload)
    except struct_error as error:
        raise EncodeError(f"a field of {packet} is out of range ({error})") from error
    body = b"".join(parts)
    room = packet_len - CRC_LEN
    if len(body) > room:
        raise EncodeError(f"{len(body) + CRC_LEN} bytes do not fit packet_len {packet_len}")
    body = body.ljust(room, b"\0")
    return body + _crc.pack(crc_hqx(body, 0))


def _pack_topic_ids(entries: tuple[Entry, ...]) -> bytes:
    ids = [entry.topic_id for entry in entries]
    if min(ids) < 0 or max(ids) > 15:
        raise EncodeError(f"topic ids {ids} are not all in 0..15")
    if len(ids) % 2:
        ids.append(0)
    return bytes([high << 4 | low for high, low in zip(ids[::2], ids[1::2], strict=True)])


def decode(data: bytes, packet_len: int) -> Packet:
    """Read exactly ``packet_len`` bytes.

    The spare low nibble of the topic ids is ignored, and QoS 11 reads as default (0).

    :raises WireError: LengthError, CrcError, VersionError, NoEntriesError, EntryBoundsError, TotalError,
        IndexRangeError or PadError, in this order of checks
    """
    if len(data) != packet_len or packet_len < HEADER_LEN + CRC_LEN:
        raise LengthError(f"{len(data)} bytes where packet_len is {packet_len}")
    # Over the whole packet, the CRC included, the remainder of an intact one is 0.
    if crc_hqx(data, 0):
        raise CrcError("CRC-16 does not match")
    flags, src_id, dst_id, seq, hop_count = _header.unpack_from(data)
    if flags >> 4 != VERSION:
        raise VersionError(f"version {flags >> 4}; this decoder reads version {VERSION}")
    count = hop_count & 15
    if not count:
        raise NoEntriesError("entry count is 0")
    end = packet_len - CRC_LEN
    position = overhead(count) - CRC_LEN
    entries = []
    for number in range(count):
        start = position + ENTRY_HEADER_LEN
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
        ids = data[HEADER_LEN + (number >> 1)]
        topic_id = ids & 15 if number & 1 else ids >> 4
        entries.append(Entry(topic_id, entry_id, index, total, data[start:position]))
    if data.count(0, position, end) != end - position:
        raise PadError(f"PAD from byte {position} is not all zero")
    qos = flags >> _QOS_SHIFT & _QOS_MASK
    return Packet(
        src_id,
        dst_id,
        seq,
        hop_count >> 4,
        tuple(entries),
        VERSION,
        0 if qos == _QOS_UNASSIGNED else qos,
        bool(flags & _COMPRESSED),
        bool(flags & _ENCRYPTED),
    )
