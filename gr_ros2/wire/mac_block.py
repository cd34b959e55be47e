"""The block for medium access that a packet of version 1 carries behind its header where ``medium`` is slots.

```text
byte 0        slot in which the packet is sent, mod 256
byte 1        slots from there to the sender's next packet     0 none; 1..127; above that 127 + 4 (code - 127)
byte 2        slots from that one to the packet after it       likewise
byte 3        H, robots that the sender hears, by weight       H = 1: bytes 6 to 11; 0..63; above 63 + 3 (code - 63)
bytes 4, 5    two robots that the sender hears                 255 none
bytes 6..9    W - 1 in the upper 4 bits, map below             bit i: the sender expects to receive in slot + 1 + i
byte 10       slots to one that two robots want                0 none
byte 11       the robot of these two that gives it up
```

W is the weight of the sender: the packets that it sends while others send one. A short block has W = 1.

Invariants: reading raises nothing but an EntryBoundsError, for a block that is cut off; every block has one encoding.
"""

from __future__ import annotations

from struct import Struct
from typing import NamedTuple

from gr_ros2.core.errors import EncodeError, EntryBoundsError

SLOT_NUMBERS = 256
"""Slots are counted modulo this."""
MAP_SLOTS = 28
"""Slots of a map."""
MOST_WEIGHT = 16
NOBODY = 255
"""In place of a name."""
LONGEST_AHEAD = 127 + 4 * 128
"""Most slots from one send to the next that can be announced."""
MOST_LEN = 12
"""Bytes of the longest block."""

_SHORT, _LONG = Struct(">BBBBBB"), Struct(">IBB")
_HIDDEN = 0x80


class Block(NamedTuple):
    """What a robot says about the slots.

    :param slot: in which the packet is sent, mod 256
    :param ahead: slots from this packet to the sender's next one, and from that to the one after; 0 for none
    :param heard: sum of the weights of the robots that the sender hears: their number where none relays
    :param names: two of them, 255 for none
    :param expected: map; bit i set: the sender expects to receive in ``slot + 1 + i``. None where there is no map
    :param conflict: slots to one that two robots want, and the one of them that gives it up; (0, 255) for none
    :param weight: packets that the sender sends while others send one, 1 to 16; 1 where there is no map
    """

    slot: int
    ahead: tuple[int, int] = (0, 0)
    heard: int = 0
    names: tuple[int, int] = (NOBODY, NOBODY)
    expected: int | None = None
    conflict: tuple[int, int] = (0, NOBODY)
    weight: int = 1

    def describe(self) -> str:
        after = ", ".join(f"+{sum(self.ahead[:n])}" for n in (1, 2) if self.ahead[n - 1]) or "not announced"
        names = ", ".join(str(name) for name in self.names if name != NOBODY)
        text = f"slot {self.slot}, next sends {after}, hears {self.heard} robots{names and f', among them {names}'}"
        if self.expected is None:
            return text
        slots = ", ".join(f"+{i + 1}" for i in range(MAP_SLOTS) if self.expected >> i & 1) or "no slot"
        text += f", expects to receive in {slots}, weight {self.weight}"
        at, yields = self.conflict
        return f"{text}, robot {yields} gives up +{at}" if at else text


def announceable(ahead: int) -> int:
    """The least number of slots not below ``ahead`` that a block can announce."""
    return ahead if ahead <= 127 else min(127 + (ahead - 124) // 4 * 4, LONGEST_AHEAD)


def write_block(block: Block) -> bytes:
    """The 6 or 12 bytes of a block. A number of robots that has no code is rounded up.

    :raises EncodeError: for a field out of range
    """
    slot, ahead, heard, names, expected, conflict, weight = block
    hidden = 0 if expected is None else _HIDDEN
    try:
        first, second = (_ahead_code(n) for n in ahead)
        data = _SHORT.pack(slot, first, second, hidden | _heard_code(heard), *names)
        if expected is None:
            return data
        if expected >> MAP_SLOTS:
            raise ValueError(f"a map has {MAP_SLOTS} slots")
        return data + _LONG.pack((weight - 1) << MAP_SLOTS | expected, *conflict)
    except Exception as error:
        raise EncodeError(f"a field of {block} is out of range ({error})") from error


def read_block(data: bytes, start: int = 0) -> tuple[Block, int]:
    """The block at byte ``start``, and where it ends.

    :raises EntryBoundsError: it is cut off
    """
    end = start + block_len(data, start, len(data))
    slot, first, second, heard, *names = _SHORT.unpack_from(data, start)
    ahead = (first if first < 128 else 4 * first - 381), (second if second < 128 else 4 * second - 381)
    robots = heard & 127
    robots = robots if robots < 64 else 3 * robots - 126
    if not heard & _HIDDEN:
        return Block(slot, ahead, robots, (names[0], names[1])), end
    word, at, loser = _LONG.unpack_from(data, start + _SHORT.size)
    weight, expected = 1 + (word >> MAP_SLOTS), word & (1 << MAP_SLOTS) - 1
    return Block(slot, ahead, robots, (names[0], names[1]), expected, (at, loser), weight), end


def block_len(data: bytes, start: int, end: int) -> int:
    """Bytes of the block at byte ``start``.

    :raises EntryBoundsError: it runs past byte ``end``
    """
    size = _SHORT.size
    if end >= start + size and data[start + 3] & _HIDDEN:
        size = MOST_LEN
    if end < start + size:
        raise EntryBoundsError(f"a block for medium access runs past byte {end}")
    return size


def _ahead_code(ahead: int) -> int:
    if ahead <= 127:
        return ahead
    code, rest = divmod(ahead - 127, 4)
    if rest:
        raise ValueError(f"{ahead} slots have no code")
    return 127 + code


def _heard_code(heard: int) -> int:
    return heard if heard <= 63 else 63 + min((heard - 61) // 3, 64)
