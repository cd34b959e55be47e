"""The packet decoder: whatever the bytes, a packet or a WireError; and a packet it takes can be written again."""

from __future__ import annotations

import random
from contextlib import suppress
from functools import partial

from fuzz.loop import main, within
from gr_ros2.core.errors import WireError
from gr_ros2.wire import decode
from gr_ros2.wire.v0 import V0, EntryV0, PacketV0, with_crc, without_crc

BASE, PER_BYTE = 300, 2
"""Lines of Python that a packet may take, and more for each byte of it."""
_NO_SOURCE = 255
"""A source id that decoders take and encoders refuse."""


def wire(data: bytes) -> None:
    """Decode the bytes as they are, and again with the CRC made right, which random bytes hardly ever are."""
    for packet in (data, with_crc(data)):
        check(packet)
        within(BASE + PER_BYTE * len(packet), partial(_decoded, packet))


def _decoded(data: bytes) -> None:
    with suppress(WireError):
        decode(data, len(data))


def check(data: bytes) -> None:
    try:
        packet = V0.decode(data, len(data))
    except WireError as error:
        assert error.kind != "encode"
        return
    assert 1 <= len(packet.entries) <= 15
    if packet.src_id == _NO_SOURCE:
        return
    again = V0.encode(packet, len(data))
    assert len(again) == len(data)
    assert decode(again, len(data)) == packet == V0.decode(again, len(data))


def corpus() -> list[bytes]:
    """Packets of 1 to 15 entries without their CRC, and next to nothing."""
    rng = random.Random(1)
    found = [b"", bytes(5), bytes(12), bytes(64)]
    for count in range(1, 16):
        entries = [EntryV0(n % 16, n, 0, 1 + n, rng.randbytes(n)) for n in range(count)]
        found.append(without_crc(V0.encode(PacketV0(1, 255, count, 1, tuple(entries), qos=count % 3), 300)))
    return found


if __name__ == "__main__":
    main(wire, corpus())
