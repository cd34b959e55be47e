"""Why much of what arrives is of no use: what the other ends have set differently, without being told to check.

Invariant: others are asked at most once in ``LOOK_S``, and only while most of what arrives cannot be used, or packets
that came whole cannot be, or they ask: an end that reads all may be one that is not understood.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from math import inf
from typing import Any

from gr_ros2.radio.findings import differences, heard_nobody, signals

LOOK_S = 5.0
"""s over which packets are counted: ten of a slow radio."""
_FEW = 10
"""Useless packets and bursts in that time that say nothing yet."""
_ASKS_S = 4 * LOOK_S
"""An end that asked in this time may be in trouble."""
_NO_SETTING = ("crc", "tag", "replayed", "not_stored", "same_id")
"""Reasons to refuse a packet that other settings do not cause. Any other packet came as it was sent."""


class Mismatch:
    """Finds what other ends have set differently, when most of what arrives cannot be used.

    :param own: what this end tells those who ask, as :func:`gr_ros2.radio.findings.about` returns it
    :param ask: asks a robot; returns what has come of all questions to it, with what it is as ``about``
    :param asked_by: when each robot asked last what this end is, s
    """

    def __init__(
        self, own: Mapping[str, Any], ask: Callable[[int], Mapping[str, Any]], asked_by: Mapping[int, float]
    ) -> None:
        self._own, self._ask, self._asked_by = own, ask, asked_by
        self._looked = -inf
        self._before = 0, 0, 0, 0
        self._lines: list[str] = []
        self._trouble = False
        self._asked: set[int] = set()

    def lines(self, stats: Mapping[str, Any], robots: Sequence[int], now: float) -> list[str]:
        """One line for each difference that explains why much of what arrives cannot be used; mostly none.

        :param stats: of the link
        :param robots: those that are heard
        """
        if now < self._looked + LOOK_S:
            return self._lines
        rejected = stats["sink"]["rejected"]
        refused = sum(rejected.values()) + stats["sink"]["dropped"].get("early", 0)
        unreadable = sum(count for reason, count in rejected.items() if reason not in _NO_SETTING)
        useless, useful = refused + stats["packets"]["damaged"], stats["packets"]["in"] - refused
        counts = useless, useful, unreadable, signals(stats)
        useless, useful, unreadable, heard = (new - old for new, old in zip(counts, self._before, strict=True))
        self._looked, self._before = now, counts
        if not robots:
            useless = max(useless, heard)
        if not 0 < useless < _FEW:
            self._trouble = useless >= _FEW and (useless > useful or unreadable >= _FEW)
        if self._trouble:
            self._lines = self._found(stats, robots)
        else:
            self._lines = self._compared(robot for robot in robots if now - self._asked_by.get(robot, -inf) < _ASKS_S)
        return self._lines

    def _compared(self, robots: Iterable[int]) -> list[str]:
        told = {robot: self._ask(robot)["about"] for robot in robots}
        return [
            f"robot {robot}: {line}" for robot, other in told.items() if other for line in differences(self._own, other)
        ]

    def _found(self, stats: Mapping[str, Any], robots: Sequence[int]) -> list[str]:
        lines, silent = [], []
        for robot in robots:
            other = self._ask(robot)["about"]
            if other is None and robot not in self._asked:
                self._asked.add(robot)  # the answer is on its way
            elif other is None:
                silent.append(f"of robot {robot}, much is of no use")  # its answer is in what cannot be used
            else:
                lines += [f"robot {robot}: {line}" for line in differences(self._own, other)]
        whose = silent if robots else ["no other robot is understood"]
        signs = [re.sub("^[0-9]+ | [0-9]+ times", "", line) for line in heard_nobody(stats) if line[:7] != "nothing"]
        return lines + [f"{who}: {'; '.join(signs)} (here packet_len is {self._own['packet_len']})" for who in whose]
