"""Sequence numbers of one source: their order, their gaps, and the signs that the sender was restarted.

Invariants: ``position`` is the unwrapped sequence number, so that it orders packets although the wire has only a few
bits; after a reset positions start so far ahead that no earlier packet appears to be close.
"""

from __future__ import annotations

from collections import OrderedDict, deque
from enum import Enum
from math import inf
from typing import NamedTuple

from gr_ros2.wire import unwrap
from gr_ros2.wire.v0 import V0

RECENT_PACKETS = 64
"""How far back a packet with the same number and bytes is a duplicate."""
_REMEMBERED = 1 << V0.number_bits - 1
"""How many packets are remembered: half the numbers are read as steps back, so an older packet cannot be recognised."""
LATEST_S = 0.5
"""How late, in seconds at the recent rate, a packet may come and still belong to this numbering."""
EARLIEST_S = 2.0
"""How early, in seconds at the recent rate, a packet may come and certainly belong to this numbering."""
NEAR = 16
"""How far ahead a packet's number may be to count the missing packets where a restart is possible: a restarted sender
starts at any number, so rarely at one this close."""
_RESET_JUMP = 4096


class Arrival(Enum):
    """What a packet's sequence number says."""

    DUPLICATE = "same number and same bytes as a recent packet"
    NEXT = "follows the newest packet"
    GAP = "newer than the newest packet, others are missing"
    LATE = "older than the newest packet"
    RESET = "cannot belong to the numbering so far: a restarted sender, or an outage too long to bridge"


class CountRate:
    """How long a count takes at its recent rate.

    :param window: counts remembered
    :param least: counts that must have been seen before a rate is used
    """

    def __init__(self, window: int, least: int) -> None:
        self._seen: deque[tuple[float, int]] = deque(maxlen=window)
        self._least = least
        self._count = 0
        self._elapsed = 0.0
        self._now: float | None = None

    def observe(self, now: float, count: int) -> None:
        """Record that ``count`` further ones have passed by ``now``."""
        self._elapsed += 0.0 if self._now is None else now - self._now
        self._now = now
        self._count += count
        self._seen.append((self._elapsed, self._count))

    def skip(self, now: float) -> None:
        """Exclude the time since the last observation from the rate."""
        self._now = now

    def duration(self, count: int) -> float:
        """Seconds that ``count`` take; infinite while the rate is not known."""
        if len(self._seen) < self._least:
            return inf
        (first_time, first), (last_time, last) = self._seen[0], self._seen[-1]
        return count * (last_time - first_time) / max(last - first, 1)


class Placed(NamedTuple):
    """A packet's place: its arrival kind, its position, and how many packets are newly missing before it.

    ``missing`` is None where the number is not known: the sender may have restarted, or its numbers may have wrapped
    around.
    """

    arrival: Arrival
    position: int
    missing: int | None = 0


class SequenceTracker:
    """Places each packet of one source."""

    def __init__(self) -> None:
        self._newest: int | None = None
        self._last_time = 0.0
        self._recent: OrderedDict[int, bytes] = OrderedDict()
        self._pace = CountRate(RECENT_PACKETS, RECENT_PACKETS)

    def place(self, seq: int, data: bytes, now: float) -> Placed:
        """Place a packet by its sequence number and bytes."""
        if self._newest is None:
            return self._accept(Placed(Arrival.NEXT, seq), data, now, 1)
        newest = self._newest
        position = unwrap(seq, newest - _REMEMBERED, V0.number_bits)
        step = position - newest
        seen = self._recent.get(position)
        if step == 1 and seen is None:
            return self._accept(Placed(Arrival.NEXT, position), data, now, 1)
        if seen == data and newest - position < RECENT_PACKETS:
            return Placed(Arrival.DUPLICATE, position)
        elapsed = now - self._last_time
        # Another packet with a recent number; a packet that would have been delayed for longer than any link delays
        # one; or a silence in which the numbers may have wrapped around.
        collision = seen is not None and seen != data and step != 0
        restart = collision or (step < 0 and LATEST_S < self._pace.duration(-step) < inf)
        silence = step != 1 and elapsed > self._pace.duration(RECENT_PACKETS)
        early = self._pace.duration(step) - elapsed > EARLIEST_S  # always true while the rate is not known
        known = not restart and (0 < step <= NEAR or not (silence or early))
        missing = step - 1 if known else None
        if restart or silence:
            self._recent.clear()
            self._pace.skip(now)
            return self._accept(Placed(Arrival.RESET, newest + _RESET_JUMP + step, missing), data, now, 1)
        if step <= 0:
            return self._accept(Placed(Arrival.LATE if step else Arrival.NEXT, position), data, now, 0)
        kind = Arrival.NEXT if step == 1 else Arrival.GAP
        return self._accept(Placed(kind, position, missing), data, now, step)

    def _accept(self, placed: Placed, data: bytes, now: float, advance: int) -> Placed:
        if self._newest is None or placed.position > self._newest:
            self._newest = placed.position
        self._recent[placed.position] = data
        if len(self._recent) > _REMEMBERED:
            self._recent.popitem(last=False)
        self._pace.observe(now, advance)
        self._last_time = now
        return placed
