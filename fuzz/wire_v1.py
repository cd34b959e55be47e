"""Version 1's decoder: whatever the bytes, a packet or a named WireError; a packet it takes can be written again."""

from __future__ import annotations

import random

from fuzz.loop import main
from gr_ros2.core.errors import WireError
from gr_ros2.wire import v1
from gr_ros2.wire.control import About, Ask, Heard, Hello, Ping, Report
from gr_ros2.wire.table import AnnouncedTopic, read_table, write_table
from gr_ros2.wire.v1 import BROADCAST, Header, PacketV1, Part, RepairHeader, decode, encode

BOOT = 1_700_000_000


def wire_v1(data: bytes) -> None:
    """Decode the bytes as they are, and again with the CRC made right; and as a table of topics."""
    check(data)
    check(data + v1.crc(data, v1.session_crc(BOOT, 0)))
    try:
        table = read_table(data)
    except WireError:
        return
    assert write_table(table) == data


def check(data: bytes) -> None:
    try:
        packet = decode(data, len(data), BOOT)
    except WireError as error:
        assert error.kind != "encode"
        return
    if packet.header.src_id == BROADCAST or (packet.header.dst_id == BROADCAST and data[0] & 4):
        return  # a source or destination id that decoders take and encoders do not write
    again = encode(packet, len(data), BOOT)
    assert len(again) == len(data)
    assert decode(again, len(data), BOOT) == packet


def corpus() -> list[bytes]:
    """Packets of every kind without their CRC, and next to nothing."""
    rng = random.Random(3)
    found = [b"", bytes(5), bytes(12), b"\x10" + bytes(63)]
    parts = [Part(n, rng.randbytes(n + 1), n * 9, n * 300, bool(n % 2)) for n in range(1, 8)]
    for count in range(8):
        source = PacketV1(Header(count % 3, False, 1, count, *((3, 1) if count % 2 else ())), tuple(parts[:count]))
        found.append(encode(source, 300, BOOT, fixed=count < 4)[: -v1.CRC_LEN])
    hello = Hello(BOOT, 0, v1.TAG_LEN, 99, ((1, 2), (3, 4)))
    control = (hello, Ask(1, b"\xf0\1"), Report(1, 2, 3, 1 << 63, True, 12))
    found.append(
        encode(PacketV1(Header(3, False, 2, 7), control, RepairHeader(5, clear=True)), 80, BOOT)[: -v1.CRC_LEN]
    )
    trials = (
        Ping(1, 2, wants_about=True),
        Ping(1, 2, True, False, 3, 4, 5, -1.5),
        About(220, 1, 2, b"x"),
        Heard(1, bytes(4), 9),
    )
    found.append(
        encode(PacketV1(Header(3, False, 2, 7), trials, RepairHeader(5, clear=True)), 120, BOOT)[: -v1.CRC_LEN]
    )
    for mask in (1, 0xFF, 0x101, (1 << 127) - 3):
        repair = v1.read_repair_header(v1.write_repair_header(RepairHeader(9, mask, True)), 0, 20)
        combination = PacketV1(Header(3, False, 2, 7), (), repair, rng.randbytes(40))
        found.append(encode(combination, 80, BOOT)[: -v1.CRC_LEN])
    rows = [
        AnnouncedTopic(0, "odom", "nav_msgs/msg/Odometry", 1, True),
        AnnouncedTopic(239, "map", "nav_msgs/msg/OccupancyGrid", 2),
    ]
    found.append(write_table(rows))
    return found


if __name__ == "__main__":
    main(wire_v1, corpus())
