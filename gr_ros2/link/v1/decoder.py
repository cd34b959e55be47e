"""The receiver's side of repair: which source packets of one sender are here, and which follow from repairs.

What is held beside the bodies is a system of linear equations over GF(256) in the missing ones, in echelon form: each
equation is known by its oldest packet, its *pivot*, whose coefficient is 1. A repair spans at most 127 numbers, so does
every equation made of repairs, and the work per packet stays bounded however long the window is.

Invariants: a body given out is the one that was sent, or the packet's own check failed to notice damage; a body that
follows from equations but cannot be parsed is not believed, and all equations go with it, since one wrong one would
spread; the numbers never come round here (the caller counts how often they have); memory is bounded by ``span`` bodies
and as many equations as numbers are missing among them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

from gr_ros2.link.v1.gf256 import CAUCHY, INVERSE, TIMES
from gr_ros2.wire.v1 import MAX_WINDOW

Found = list[tuple[int, bytes]]
"""Source packets that are known now and were not before: (number, body)."""


class RepairDecoder:
    """The packets of one sender.

    :param room: bytes of the longest body
    :param plausible: whether a recovered body can be one
    :param span: numbers remembered, counted back from the newest
    """

    def __init__(self, room: int, plausible: Callable[[bytes], bool], span: int) -> None:
        self.counts: Counter[str] = Counter()
        """``recovered`` packets; repairs that were ``redundant``, ``too_old`` or held for later (``held``); and
        ``implausible`` results, each of which cost all equations."""
        self.newest = -1
        """The newest number heard of."""
        self.floor = 0
        """The oldest number remembered."""
        self._room = room
        self._plausible = plausible
        self._span = span
        self._bodies: dict[int, bytes] = {}
        self._rows: dict[int, tuple[bytes, bytes]] = {}
        """Pivot: its coefficients from the pivot on, and its right side."""

    def __contains__(self, number: int) -> bool:
        """Whether a source packet is known."""
        return number in self._bodies

    @property
    def equations(self) -> int:
        """Repairs held that do not yet tell a packet."""
        return len(self._rows)

    def begin(self, number: int) -> None:
        """Nothing older than this number will be asked for."""
        if number > self.floor:
            self._forget(number)

    def advance(self, number: int) -> None:
        """The sender has come to this number."""
        if number > self.newest:
            self.newest = number
            floor = number - self._span + 1
            if floor > self.floor:
                self._forget(floor)

    def source(self, number: int, body: bytes) -> Found:
        """A source packet came, or is known otherwise.

        :return: it and what follows from it; nothing where it was known, or is too old
        """
        if number in self._bodies or number < self.floor:
            return []
        self.advance(number)
        if not self._rows:
            self._bodies[number] = body
            return [(number, body)]
        return self._learn([(number, body)])

    def repair(self, number: int, mask: int, row: int, combined: bytes) -> Found:
        """A repair came.

        :param number: newest number of its window
        :param mask: bit i says that ``number - i`` is part of it
        :param row: of its coefficients
        :param combined: the combination
        :return: the packets that follow
        """
        self.advance(number)
        bodies = self._bodies
        numbers = window_numbers(number, mask)
        missing = [member for member in numbers if member not in bodies]
        if not missing:
            self.counts["redundant"] += 1
            return []
        if missing[-1] < self.floor:
            self.counts["too_old"] += 1
            return []
        shifted = 128 | row
        right = int.from_bytes(combined, "little")
        for member in numbers:
            body = bodies.get(member)
            if body is not None:
                right ^= int.from_bytes(body.translate(CAUCHY[shifted ^ member & 127]), "little")
        pivot = missing[-1]
        left = 0
        for member in missing:
            left |= INVERSE[shifted ^ member & 127] << (member - pivot) * 8
        return self._learn(self._insert(pivot, left, right))

    def _insert(self, pivot: int, left: int, right: int) -> Found:
        """Take an equation in, reduced by those held; the packet that it tells by itself."""
        rows, room = self._rows, self._room
        while left:
            shift = ((left & -left).bit_length() - 1) >> 3
            pivot += shift
            left >>= shift * 8
            held = rows.get(pivot)
            if held is None:
                break
            factor = TIMES[left & 255]
            left ^= int.from_bytes(held[0].translate(factor), "little")
            right ^= int.from_bytes(held[1].translate(factor), "little")
        else:
            if right:
                return self._disbelieve()
            self.counts["redundant"] += 1
            return []
        factor = TIMES[INVERSE[left & 255]]
        body = right.to_bytes(room, "little").translate(factor)
        if left < 256:
            return self._believe(pivot, body)
        self.counts["held"] += 1
        rows[pivot] = (left.to_bytes((left.bit_length() + 7) >> 3, "little").translate(factor), body)
        return []

    def _learn(self, found: Found) -> Found:
        """Put packets that are known into the equations; these and all that follow."""
        bodies, rows, room = self._bodies, self._rows, self._room
        done = 0
        while done < len(found):
            number, body = found[done]
            done += 1
            bodies[number] = body
            if not rows:
                continue
            more: Found = []
            for pivot in self._naming(number):
                left, right = rows[pivot]
                at = number - pivot
                factor = left[at]
                rest = int.from_bytes(left, "little") ^ factor << at * 8
                side = int.from_bytes(right, "little") ^ int.from_bytes(body.translate(TIMES[factor]), "little")
                if rest > 1:
                    size = (rest.bit_length() + 7) >> 3
                    rows[pivot] = (rest.to_bytes(size, "little"), side.to_bytes(room, "little"))
                else:
                    del rows[pivot]
                    more += self._believe(pivot, side.to_bytes(room, "little"))
                    if not rows:
                        break
            own = rows.pop(number, None)  # last, so that no equation that still names the packet goes into it
            if own is not None:
                rest = int.from_bytes(own[0], "little") ^ 1
                side = int.from_bytes(own[1], "little") ^ int.from_bytes(body, "little")
                more += self._insert(number, rest, side)
            known = {item[0] for item in found}
            found += [item for item in more if item[0] not in known and item[0] not in bodies]
        return found

    def _naming(self, number: int) -> list[int]:
        """Pivots, older than it, of the equations that have a packet in them."""
        rows = self._rows
        if len(rows) < MAX_WINDOW:
            pivots = [pivot for pivot in rows if pivot < number]
        else:
            pivots = [pivot for pivot in range(number - MAX_WINDOW + 1, number) if pivot in rows]
        return [pivot for pivot in pivots if number - pivot < len(rows[pivot][0]) and rows[pivot][0][number - pivot]]

    def _believe(self, number: int, body: bytes) -> Found:
        """A body that follows from equations, if it can be one."""
        if not self._plausible(body):
            return self._disbelieve()
        self.counts["recovered"] += 1
        return [(number, body)]

    def _disbelieve(self) -> Found:
        """Something in the equations is wrong, and nobody knows what."""
        self.counts["implausible"] += 1
        self._rows.clear()
        return []

    def _forget(self, floor: int) -> None:
        """Remember nothing older than ``floor``."""
        bodies, rows = self._bodies, self._rows
        if floor - self.floor > len(bodies):
            for number in [number for number in bodies if number < floor]:
                del bodies[number]
        else:
            for number in range(self.floor, floor):
                bodies.pop(number, None)
        if rows:
            for pivot in [pivot for pivot in rows if pivot < floor]:
                del rows[pivot]
        self.floor = max(self.floor, floor)


def window_numbers(number: int, mask: int) -> list[int]:
    """The numbers of a repair's window, newest first."""
    window = mask.bit_length()
    if mask + 1 == 1 << window:
        return list(range(number, number - window, -1))
    return [number - back for back in range(window) if mask >> back & 1]
