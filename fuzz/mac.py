"""Medium access: whatever blocks are heard, a robot goes on sending in slots, and a block costs a bounded work."""

from __future__ import annotations

import random
from functools import partial

from fuzz.loop import main, within
from gr_ros2.core.errors import EntryBoundsError
from gr_ros2.mac import Slots
from gr_ros2.wire.mac_block import MAP_SLOTS, Block, read_block, write_block

MOST_LINES = 4000
"""Lines of Python for a block heard; of which the most go to the 255 robots that an odd clock is compared with."""
_SLOT_S = 0.0145
_STEP = 15
"""Bytes that make a packet: sender, time, whether checked, block."""


def mac(data: bytes) -> None:
    """Take the bytes as packets heard, and send in between."""
    robot = Slots(1, _SLOT_S, random.Random(1), period_s=0.1)
    now = 0.0
    for start in range(0, min(len(data), 40 * _STEP), _STEP):
        src_id, later, trusted = (data[start : start + 3] + bytes(3))[:3]
        now += later * _SLOT_S / 16
        try:
            block, _ = read_block(data, start + 3)
        except EntryBoundsError:
            break
        within(MOST_LINES, partial(robot.hear, src_id, block, now, trusted=trusted % 3 > 1, checked=trusted % 3 > 0))
        due = robot.departure(now)
        if due <= now + _SLOT_S:
            sent = robot.block()
            assert sent is None or read_block(sent)[1] == len(sent)


def corpus() -> list[bytes]:
    """Robots that take turns, and next to nothing."""
    turns = b""
    for n in range(40):
        slot, expected = n * 4 % 256, 1 << n % MAP_SLOTS
        block = Block(slot, (8, 8), 2, (1, 3), expected, (5, 1)) if n % 2 else Block(slot, (8, 8))
        turns += bytes((2 + n % 2, 64, 1)) + write_block(block).ljust(12, b"\0")
    return [b"", turns[:15], turns]


if __name__ == "__main__":
    main(mac, corpus())
