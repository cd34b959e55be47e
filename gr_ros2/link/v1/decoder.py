"""The receiver's side of repair: which source packets of one sender are known, and which follow from repairs.

The decoder holds the bodies that are known. For the missing ones it holds a system of linear equations over GF(256) in
echelon form. Each equation is stored under its oldest packet, its *pivot*, whose coefficient is 1. A repair spans at
most 127 numbers, and so does every equation made of repairs. At most ``MOST_EQUATIONS`` are held, so the work per
packet is bounded, however long the window is and whatever is sent.

Invariants: a body that the decoder returns is the one that was sent, unless the packet's own check failed to notice
damage; a body that follows from equations but cannot be parsed is dropped together with all equations, since one wrong
equation would spread; packet numbers do not wrap around here (the caller counts how often they have); memory is bounded
by ``span`` bodies and the number of equations.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Any

from gr_ros2.link.v1.gf256 import CAUCHY, INVERSE, TIMES
from gr_ros2.wire.v1 import MAX_WINDOW

MOST_EQUATIONS = 4096
"""Equations held. A packet may pass through all of them, which takes some ms; a message of 10,000 packets at 20 % loss
needs fewer."""

Found = list[tuple[int, bytes]]
"""Source packets that have become known: (number, body)."""


class RepairDecoder:
    """The source packets of one sender that are known, and the equations for the missing ones.

    :param room: bytes of the longest body
    :param plausible: whether a recovered body can be valid
    :param span: numbers remembered, counted back from the newest
    :param equations: most equations held
    """

    def __init__(
        self, room: int, plausible: Callable[[bytes], bool], span: int, equations: int = MOST_EQUATIONS
    ) -> None:
        self.counts: Counter[str] = Counter()
        """Counts: ``recovered`` packets; repairs that were ``redundant``, ``too_old``, ``too_many`` or stored for later
        (``held``); ``implausible`` results. Each implausible result discards all equations."""
        self.newest = -1
        """The newest number seen."""
        self.floor = 0
        """The oldest number remembered."""
        self._room = room
        self._plausible = plausible
        self._span = span
        self._most = equations
        self.bodies: dict[int, bytes] = {}
        """Those of the source packets that are known, by number."""
        self._equations: dict[int, tuple[bytes, bytes]] = {}
        """By pivot: the coefficients of the equation from the pivot on, and its right side."""
        self._grown = False
        """Whether an equation was added since they were solved for each other's pivots."""

    def __contains__(self, number: int) -> bool:
        """Whether a source packet is known."""
        return number in self.bodies

    @property
    def equations(self) -> int:
        """Number of equations held that do not determine a packet yet."""
        return len(self._equations)

    def lacks(self, first: int) -> bool:
        """Whether an equation is held that does not determine a packet yet and names none before ``first``."""
        return any(pivot >= first for pivot in self._equations)

    def begin(self, number: int) -> None:
        """Ignore all packets older than this number."""
        if number > self.floor:
            self._forget(number)

    def advance(self, number: int) -> None:
        """The sender has reached this number."""
        if number > self.newest:
            self.newest = number
            floor = number - self._span + 1
            if floor > self.floor:
                self._forget(floor)

    def source(self, number: int, body: bytes) -> Found:
        """Take a source packet that arrived or is known in another way.

        :return: this packet and those that follow from it; nothing if it was known already or is too old
        """
        if number in self.bodies or number < self.floor:
            return []
        if number > self.newest:
            self.advance(number)
        if not self._equations:
            self.bodies[number] = body
            return [(number, body)]
        return self._learn([(number, body)])

    def repair(self, number: int, mask: int, repair_id: int, combined: bytes) -> Found:
        """Take a repair.

        :param number: newest number of its window
        :param mask: bit i says that packet ``number - i`` is part of it
        :param repair_id: says its coefficients
        :param combined: the linear combination of the bodies
        :return: the packets that follow from it
        """
        if number > self.newest:
            self.advance(number)
        bodies = self.bodies
        numbers = window_numbers(number, mask)
        missing = [member for member in numbers if member not in bodies]
        if not missing:
            self.counts["redundant"] += 1
            return []
        if missing[-1] < self.floor:
            self.counts["too_old"] += 1
            return []
        shifted = 128 | repair_id
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
        """Reduce an equation by those held and store it; return the packet that it determines by itself."""
        equations, room = self._equations, self._room
        while left:
            shift = ((left & -left).bit_length() - 1) >> 3
            pivot += shift
            left >>= shift * 8
            held = equations.get(pivot)
            if held is None or left < 256:
                break
            size = (left.bit_length() + 7) >> 3
            if size < len(held[0]):  # equations that reach less far determine packets sooner
                factor = TIMES[INVERSE[left & 255]]
                sides = left.to_bytes(size, "little"), right.to_bytes(room, "little")
                equations[pivot] = sides[0].translate(factor), sides[1].translate(factor)
                left, right = (int.from_bytes(side, "little") for side in held)
                held, self._grown = equations[pivot], True
            factor = TIMES[left & 255]
            left ^= int.from_bytes(held[0].translate(factor), "little")
            right ^= int.from_bytes(held[1].translate(factor), "little")
        else:
            if right:
                return self._reject()
            self.counts["redundant"] += 1
            return self._solve()
        factor = TIMES[INVERSE[left & 255]]
        body = right.to_bytes(room, "little").translate(factor)
        if left < 256:
            return self._accept(pivot, body)
        if len(equations) >= self._most:
            self.counts["too_many"] += 1
            return []
        self.counts["held"] += 1
        self._grown = True
        equations[pivot] = (left.to_bytes((left.bit_length() + 7) >> 3, "little").translate(factor), body)
        return []

    def _learn(self, found: Found) -> Found:
        """Put packets that have become known into the equations; return these and all that follow."""
        bodies, equations, room = self.bodies, self._equations, self._room
        known = {number for number, _ in found}
        done = 0
        while done < len(found):
            number, body = found[done]
            done += 1
            bodies[number] = body
            if not equations:
                continue
            more: Found = []
            for pivot in self._naming(number):
                left, right = equations[pivot]
                at = number - pivot
                factor = left[at]
                rest = int.from_bytes(left, "little") ^ factor << at * 8
                side = int.from_bytes(right, "little") ^ int.from_bytes(body.translate(TIMES[factor]), "little")
                if rest > 1:
                    size = (rest.bit_length() + 7) >> 3
                    equations[pivot] = (rest.to_bytes(size, "little"), side.to_bytes(room, "little"))
                else:
                    del equations[pivot]
                    more += self._accept(pivot, side.to_bytes(room, "little"))
                    if not equations:
                        break
            own = equations.pop(number, None)  # last, so that no equation that still names the packet goes into it
            if own is not None:
                rest = int.from_bytes(own[0], "little") ^ 1
                side = int.from_bytes(own[1], "little") ^ int.from_bytes(body, "little")
                more += self._insert(number, rest, side)
            for item in more:
                if item[0] not in known and item[0] not in bodies:
                    known.add(item[0])
                    found.append(item)
        return found

    def _solve(self) -> Found:
        """Take the pivots out of each other's equations; return the packets that this determines.

        A repair that follows from the equations may name packets that they determine together, while none does so
        alone: those of which older packets are not worth a repair any more, for instance. No equation reaches further
        afterwards. The next repairs of few packets would otherwise replace such an equation again and again, and never
        become as many as these packets, where the equations behind reach too far to be taken out.
        """
        equations, room = self._equations, self._room
        if not self._grown or len(equations) > MAX_WINDOW:
            return []
        self._grown = False
        found: Found = []
        pivots = sorted(equations)
        for index in range(len(pivots) - 2, -1, -1):
            pivot = pivots[index]
            coefficients = equations[pivot][0]
            left, right = (int.from_bytes(side, "little") for side in equations[pivot])
            before = left
            for other in pivots[index + 1 :]:
                shift = other - pivot
                if left >> shift * 8 == 0:
                    break
                factor = left >> shift * 8 & 255
                if not factor or other not in equations or shift + len(equations[other][0]) > MAX_WINDOW:
                    continue
                more, side = (int.from_bytes(held.translate(TIMES[factor]), "little") for held in equations[other])
                left, right = left ^ more << shift * 8, right ^ side
            size = (left.bit_length() + 7) >> 3
            if left == 1:
                del equations[pivot]
                found += self._accept(pivot, right.to_bytes(room, "little"))
                if not equations:
                    break
            elif left != before and size <= len(coefficients):
                equations[pivot] = (left.to_bytes(size, "little"), right.to_bytes(room, "little"))
        return found

    def _naming(self, number: int) -> list[int]:
        """Pivots, older than this packet, of the equations that contain it."""
        equations = self._equations
        if len(equations) < MAX_WINDOW:
            pivots = [pivot for pivot in equations if pivot < number]
        else:
            pivots = [pivot for pivot in range(number - MAX_WINDOW + 1, number) if pivot in equations]
        return [
            pivot
            for pivot in pivots
            if number - pivot < len(equations[pivot][0]) and equations[pivot][0][number - pivot]
        ]

    def _accept(self, number: int, body: bytes) -> Found:
        """Return a body that follows from equations, if it is plausible."""
        if not self._plausible(body):
            return self._reject()
        self.counts["recovered"] += 1
        return [(number, body)]

    def _reject(self) -> Found:
        """Discard all equations: one of them is wrong, and it is not known which."""
        self.counts["implausible"] += 1
        self._equations.clear()
        return []

    def _forget(self, floor: int) -> None:
        """Forget everything older than ``floor``."""
        held: dict[int, Any]
        for held in (self.bodies, self._equations):
            if floor - self.floor > len(held):
                for number in [number for number in held if number < floor]:
                    del held[number]
            else:
                for number in range(self.floor, floor):
                    held.pop(number, None)
        self.floor = floor


def window_numbers(number: int, mask: int) -> list[int]:
    """The numbers of a repair's window, newest first."""
    window = mask.bit_length()
    if mask + 1 == 1 << window:
        return list(range(number, number - window, -1))
    return [number - back for back in range(window) if mask >> back & 1]
