"""Packets that overtake each other on their way over several radios: which messages wait for those before them.

Like radios carry two packets at a time, and which of them comes first is chance: 3 to 11 % come after a later one, most
of them by 1 ms. Of a topic without reliable publishers the earlier message would be left out, since none comes out
after a later one. So a message waits while a packet before it is missing that may have been overtaken, as long as such
packets lately took, and only while some are. What is of no use when it is old (a command) does not wait. Nor is a
packet lost before that time: of two radios that lose nothing, 16 to 33 % counted as lost otherwise.

Invariants: messages of one topic come out in the order in which they began; none waits for longer than
``overtaken_most_s``.
"""

from __future__ import annotations

from collections import deque
from math import inf

from gr_ros2.core.tuning import Tuning
from gr_ros2.link.v1.decoder import RepairDecoder
from gr_ros2.link.v1.gap_contents import GapContents
from gr_ros2.link.v1.order import Ready


class Overtaken:
    """How many packets of a robot are overtaken, and how late these are. It is kept when the robot restarts: else about
    ten messages of the new start were overtaken before any waited."""

    def __init__(self, tuning: Tuning) -> None:
        self.tuning = tuning
        self._share, self._late_s = 0.0, tuning.overtaken_most_s / tuning.overtaken_times

    @property
    def wait_s(self) -> float:
        """s for which a missing packet is waited for now."""
        most_s = min(self.tuning.overtaken_times * self._late_s, self.tuning.overtaken_most_s)
        return most_s if self._share >= self.tuning.overtaken_some else 0.0

    def came(self, late_s: float) -> None:
        """A packet has come.

        :param late_s: s since later ones have; infinite where it is the newest
        """
        overtaken = late_s <= self.tuning.overtaken_most_s
        self._share += (overtaken - self._share) * self.tuning.overtaken_share_weight
        if overtaken:
            self._late_s += (late_s - self._late_s) * self.tuning.overtaken_time_weight


class Overtaking:
    """The messages of one sender that wait for packets that may have been overtaken.

    :param decoder: knows which packets are here
    :param contents: knows which topics missing ones can have carried
    :param learned: of this robot's packets so far
    """

    def __init__(self, decoder: RepairDecoder, contents: GapContents, learned: Overtaken) -> None:
        self._decoder, self._contents, self._learned = decoder, contents, learned
        self._gaps: deque[tuple[float, int, int]] = deque()
        """Packets that were missed in the last ``overtaken_most_s``: when (s), the first and the last of them."""
        self._untold: deque[tuple[float, int, int]] = deque()
        """Those of them of which it is not told yet whether they are lost."""
        self._waiting: list[Ready] = []

    def missing(self, now: float, first: int, last: int) -> None:
        """These packets had not come when a later one did."""
        while self._gaps and self._gaps[0][0] + self._learned.tuning.overtaken_most_s < now:
            self._gaps.popleft()
        self._gaps.append((now, first, last))
        self._untold.append((now, first, last))

    def came(self, number: int, now: float, *, late: bool) -> None:
        """A packet has come for the first time.

        :param late: after a later one
        """
        since = next((since for since, first, last in self._gaps if first <= number <= last), -inf) if late else -inf
        self._learned.came(now - since)

    def lost(self, now: float) -> int:
        """How many packets have become too late to have been overtaken; each is counted once."""
        lost, wait_s, here = 0, self._learned.wait_s, self._decoder.bodies
        while self._untold and self._untold[0][0] + wait_s <= now:
            _, first, last = self._untold.popleft()
            lost += sum(number not in here for number in range(first, last + 1))
        return lost

    def holds(self, ready: Ready, now: float) -> bool:
        """Whether a message waits; keeps it until :meth:`due` returns it."""
        behind = any(other.topic_id == ready.topic_id for other in self._waiting)
        if not behind and self._until(ready, now) <= now:
            return False
        self._waiting.append(ready)
        return True

    def due(self, now: float) -> list[Ready]:
        """The messages that need not wait any more, in their order."""
        if not self._waiting:
            return []
        self._waiting.sort(key=lambda ready: ready.order)
        topics: set[int] = set()
        due, waiting = [], []
        for ready in self._waiting:
            if ready.topic_id in topics or self._until(ready, now) > now:
                topics.add(ready.topic_id)
                waiting.append(ready)
            else:
                due.append(ready)
        self._waiting = waiting
        return due

    def next_timeout(self) -> float | None:
        """When :meth:`lost` or :meth:`due` has something to return at the latest, s; None where nothing waits."""
        times = [self._until(ready, -inf) for ready in self._waiting]
        times += [since + self._learned.wait_s for since, _, _ in self._untold]
        return min(times, default=None)

    def clear(self) -> list[Ready]:
        """The messages that wait, in their order; none waits any more."""
        waiting, self._waiting = sorted(self._waiting, key=lambda ready: ready.order), []
        return waiting

    def _until(self, ready: Ready, now: float) -> float:
        """Until when packets before a message may come, s; -inf where none is missing."""
        wait_s, here, may_carry = self._learned.wait_s, self._decoder.bodies, self._contents.may_carry
        for since, first, last in reversed(self._gaps):
            if since + wait_s <= now:
                break
            numbers = range(first, min(last + 1, ready.order[0]))
            if any(number not in here and may_carry(number, ready.topic_id) for number in numbers):
                return since + wait_s
        return -inf
