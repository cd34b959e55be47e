"""The packet codec alone, on one core."""

from __future__ import annotations

import time

from bench.rows import Row, median_of
from gr_ros2.wire.v0 import V0, Entry, Packet

PACKET_LEN, PACKETS, REPEATS = 64, 20_000, 9
TARGET = 150_000


def codec() -> list[Row]:
    """Encode and decode of the same packets, one after the other."""
    packets = [Packet(1, 255, n & 255, 1, (Entry(0, n & 255, 0, 1, bytes(51)),)) for n in range(PACKETS)]

    def rate() -> float:
        begin = time.perf_counter()
        for packet in packets:
            V0.decode(V0.encode(packet, PACKET_LEN), PACKET_LEN)
        return PACKETS / (time.perf_counter() - begin)

    return [Row("codec: encode + decode, 64 B", median_of(REPEATS, rate), "packets/s", "≥", TARGET)]
