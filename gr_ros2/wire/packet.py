"""Packets of version 0 as values, and the arithmetic of their sizes (the paper, section 5 and table 3).

Law: a Packet or Entry is immutable and says nothing about bytes; ``codec`` alone knows those.
"""

from __future__ import annotations

from dataclasses import dataclass

HEADER_LEN = 5
ENTRY_HEADER_LEN = 5
CRC_LEN = 2
MAX_ENTRIES = 15
MAX_TOTAL = 255
"""Most fragments a message can have: ``total`` is one byte."""

QOS_DEFAULT, QOS_LATENCY, QOS_BULK = 0, 1, 2


@dataclass(frozen=True, slots=True)
class Entry:
    """One fragment of one message.

    :param topic_id: registry row, 0..15
    :param entry_id: names the message among those of its source and topic, 0..255
    :param index: position of the fragment, from 0
    :param total: fragments of the message, 1..255
    :param payload: bytes of the serialized message
    """

    topic_id: int
    entry_id: int
    index: int
    total: int
    payload: bytes


@dataclass(frozen=True, slots=True)
class Packet:
    """One packet, without its length: that is a property of the link.

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
    entries: tuple[Entry, ...]
    version: int = 0
    qos: int = 0
    compressed: bool = False
    encrypted: bool = False


def overhead(entries: int) -> int:
    """Bytes of a packet that belong to no entry: 7 + ceil(E/2)."""
    return HEADER_LEN + (entries + 1) // 2 + CRC_LEN


def single_entry_payload(packet_len: int) -> int:
    """Most payload bytes of a packet with one entry, k_max(1) = packet_len - 13."""
    return packet_len - overhead(1) - ENTRY_HEADER_LEN


def equal_entry_payload(packet_len: int, entries: int) -> int:
    """k*(E), most payload bytes of each of E equal entries (section 5.2); negative where E entries do not fit."""
    return (packet_len - overhead(entries)) // entries - ENTRY_HEADER_LEN


def pad_len(packet_len: int, payload_lens: list[int]) -> int:
    """L_pad (section 5.3); negative where the entries do not fit."""
    return packet_len - overhead(len(payload_lens)) - sum(ENTRY_HEADER_LEN + k for k in payload_lens)
