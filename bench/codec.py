"""The packet codec alone, on one core, beside plain Python."""

from __future__ import annotations

import time

from bench.rows import Row
from bench.yardstick import cost
from gr_ros2.wire.v0 import V0, EntryV0, PacketV0

PACKET_LEN, PACKETS, REPEATS = 64, 20_000, 9
MOST = 100
"""Turns of plain Python that a packet may take."""


def codec() -> list[Row]:
    """Encode and decode of the same packets, one after the other."""
    packets = [PacketV0(1, 255, n & 255, 1, (EntryV0(0, n & 255, 0, 1, bytes(51)),)) for n in range(PACKETS)]

    def each() -> float:
        begin = time.thread_time()
        for packet in packets:
            V0.decode(V0.encode(packet, PACKET_LEN), PACKET_LEN)
        return (time.thread_time() - begin) / PACKETS

    took = cost(REPEATS, each)
    what = "codec: encode + decode, 64 B, over a turn of plain Python"
    return [Row(what, took.turns, "", "≤", MOST, "{:.0f}", took.note)]
