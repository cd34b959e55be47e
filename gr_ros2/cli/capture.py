"""Reads packets from hex text, files of back-to-back packets, and pcap and pcapng captures.

Invariant: nothing is dropped silently. Bytes that are not a packet are passed on, and the decoder refuses them. A
capture that cannot be read at all raises a ConfigError.
"""

from __future__ import annotations

import struct
from binascii import unhexlify
from collections.abc import Iterable, Iterator

from gr_ros2.core.errors import ConfigError
from gr_ros2.settings.config import MIN_PACKET_LEN
from gr_ros2.settings.robot import RobotConfig

DEFAULT_PACKET_LEN = RobotConfig.packet_len

_ETHERNET, _RAW_IP, _LINUX_SLL = 1, 101, 113
_IP_OFFSET = {_ETHERNET: 14, _RAW_IP: 0, _LINUX_SLL: 16}
_PCAP_MAGIC = {0xA1B2C3D4, 0xA1B23C4D}
_PCAPNG_MAGIC = b"\x0a\x0d\x0d\x0a"
_PCAPNG_ORDER = 0x1A2B3C4D
_INTERFACE, _SIMPLE, _ENHANCED = 1, 3, 6
_UDP = 17


def packets_in(data: bytes, packet_len: int | None, where: str) -> Iterator[tuple[bytes, int]]:
    """The packets of one file, each with its expected length. The file is a capture, hex text with one packet per line,
    or packets back to back.

    :param packet_len: None: each hex line and each record is a packet of its own length, and binary data is cut into
        packets of DEFAULT_PACKET_LEN; a shorter rest is returned unchanged
    :param where: name of the file, for errors
    :raises ConfigError: when a capture is damaged
    """
    if data[:4] == _PCAPNG_MAGIC:
        packets: Iterable[bytes] = _pcapng(data, where)
    elif len(data) >= 24 and _pcap_order(data):
        packets = _pcap(data, where)
    elif (lines := _hex_lines(data)) is not None:
        packets = lines
    else:
        packet_len = packet_len or DEFAULT_PACKET_LEN
        packets = (data[start : start + packet_len] for start in range(0, len(data), packet_len))
    for packet in packets:
        yield packet, packet_len or max(len(packet), MIN_PACKET_LEN)


def from_hex(text: str) -> bytes | None:
    """Bytes of hex digits, with or without spaces and colons between them; None for any other text."""
    digits = text.strip().removeprefix("0x").replace(" ", "").replace(":", "").replace("\t", "")
    try:
        return unhexlify(digits) if digits else None
    except (ValueError, UnicodeEncodeError):
        return None


def _hex_lines(data: bytes) -> list[bytes] | None:
    try:
        lines = [line.split("#", 1)[0].strip() for line in data.decode("ascii").splitlines()]
    except UnicodeDecodeError:
        return None
    packets = [from_hex(line) for line in lines if line]
    return [packet for packet in packets if packet is not None] if packets and None not in packets else None


def _pcap_order(data: bytes) -> str | None:
    return next((order for order in "<>" if struct.unpack_from(order + "I", data)[0] in _PCAP_MAGIC), None)


def _pcap(data: bytes, where: str) -> Iterator[bytes]:
    order = _pcap_order(data)
    link_type = struct.unpack_from(f"{order}I", data, 20)[0] & 0xFFFF
    position, number = 24, 0
    while position < len(data):
        number += 1
        if position + 16 > len(data):
            raise ConfigError(f"{where}: the capture ends inside the header of record {number}")
        length = struct.unpack_from(f"{order}I", data, position + 8)[0]
        position += 16 + length
        if position > len(data):
            raise ConfigError(f"{where}: the capture ends inside record {number}")
        yield _payload(data[position - length : position], link_type)


def _pcapng(data: bytes, where: str) -> Iterator[bytes]:
    order, position = "<", 0
    link_types: list[int] = []
    while position < len(data):
        if data[position : position + 4] == _PCAPNG_MAGIC and position + 12 <= len(data):
            order = "<" if struct.unpack_from("<I", data, position + 8)[0] == _PCAPNG_ORDER else ">"
            link_types = []
        kind, length = struct.unpack(f"{order}II", data[position : position + 8].ljust(8, b"\0"))
        if length < 12 or length % 4 or position + length > len(data):
            raise ConfigError(f"{where}: the capture is damaged at byte {position}")
        body = data[position + 8 : position + length - 4]
        position += length
        try:
            if kind == _INTERFACE:
                link_types.append(struct.unpack_from(f"{order}H", body)[0])
            elif kind == _ENHANCED:
                interface, _, _, captured = struct.unpack_from(f"{order}4I", body)
                yield _payload(body[20 : 20 + captured], link_types[interface])
            elif kind == _SIMPLE:
                original = struct.unpack_from(f"{order}I", body)[0]
                yield _payload(body[4 : 4 + original], link_types[0])
        except (struct.error, IndexError) as error:
            raise ConfigError(f"{where}: the capture is damaged before byte {position}") from error


def _payload(record: bytes, link_type: int) -> bytes:
    """The packet in a record: the payload of the UDP datagram in a capture of an IP link, otherwise all of it."""
    at = _IP_OFFSET.get(link_type)
    if at is None or len(record) < at + 28 or record[at] >> 4 != 4 or record[at + 9] != _UDP:
        return record
    udp = at + (record[at] & 15) * 4
    if udp + 8 > len(record):
        return record
    return record[udp + 8 : udp + struct.unpack_from(">H", record, udp + 4)[0]]
