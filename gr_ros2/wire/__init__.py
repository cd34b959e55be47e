"""The wire format: packets to bytes and back, one module per version. No IO, no state.

No module outside this package knows a byte offset or the width of a field; it asks a :class:`Format`. ``v0`` is the
version of the paper (section 5). ``v1`` is the version with repair, sealing and announcements.
"""

from __future__ import annotations

from collections.abc import Mapping

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
    WireError,
)
from gr_ros2.wire.format import (
    BROADCAST,
    QOS_BULK,
    QOS_DEFAULT,
    QOS_LATENCY,
    QOS_NAMES,
    Entry,
    Format,
    Packet,
    Span,
    unwrap,
    varint,
)
from gr_ros2.wire.table import AnnouncedTopic
from gr_ros2.wire.v0 import V0
from gr_ros2.wire.v1 import BOUND, V1, is_sealed

__all__ = [
    "BOUND",
    "BROADCAST",
    "FORMATS",
    "QOS_BULK",
    "QOS_DEFAULT",
    "QOS_LATENCY",
    "QOS_NAMES",
    "AnnouncedTopic",
    "CrcError",
    "EncodeError",
    "Entry",
    "EntryBoundsError",
    "Format",
    "IndexRangeError",
    "LengthError",
    "NoEntriesError",
    "Packet",
    "PadError",
    "Span",
    "TotalError",
    "VersionError",
    "WireError",
    "decode",
    "format_of",
    "is_sealed",
    "unwrap",
    "varint",
]

FORMATS: Mapping[int, Format] = {V0.version: V0, V1.version: V1}
"""The formats by version."""


def format_of(version: int) -> Format:
    """The format of a version.

    :raises VersionError: for an unknown version
    """
    if version not in FORMATS:
        raise VersionError(f"version {version}; known are {', '.join(map(str, FORMATS))}")
    return FORMATS[version]


def decode(data: bytes, packet_len: int) -> Packet:
    """The packet in these bytes, read by the version that its first four bits give.

    Bytes with an unknown version are checked by the rules of version 0: damaged bytes are refused by the CRC (a damaged
    version nibble is damage like any other), all others by the version.

    :param packet_len: packet length of the link, bytes
    :raises WireError: see the ``decode`` of each version
    """
    return FORMATS.get(data[0] >> 4 if data else 0, V0).decode(data, packet_len)
