"""The wire format: packets of version 0 (the paper, section 5) to bytes and back. No IO, no state."""

from __future__ import annotations

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
    WireError,
)
from gr_ros2.wire.codec import VERSION, crc16, decode, encode
from gr_ros2.wire.packet import (
    CRC_LEN,
    ENTRY_HEADER_LEN,
    HEADER_LEN,
    MAX_ENTRIES,
    MAX_TOTAL,
    QOS_BULK,
    QOS_DEFAULT,
    QOS_LATENCY,
    Entry,
    Packet,
    equal_entry_payload,
    overhead,
    pad_len,
    single_entry_payload,
)

__all__ = [
    "CRC_LEN",
    "ENTRY_HEADER_LEN",
    "HEADER_LEN",
    "MAX_ENTRIES",
    "MAX_TOTAL",
    "QOS_BULK",
    "QOS_DEFAULT",
    "QOS_LATENCY",
    "VERSION",
    "CrcError",
    "EncodeError",
    "Entry",
    "EntryBoundsError",
    "IndexRangeError",
    "LengthError",
    "NoEntriesError",
    "Packet",
    "PadError",
    "TotalError",
    "VersionError",
    "WireError",
    "crc16",
    "decode",
    "encode",
    "equal_entry_payload",
    "overhead",
    "pad_len",
    "single_entry_payload",
]
