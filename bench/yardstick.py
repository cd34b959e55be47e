"""Plain Python as the yardstick of work in Python: what a machine needs for both, it needs in the same ratio.

A *turn* is one turn of a loop that calls a small function. Work and yardstick are measured one after the other, in
processor time of the thread, so neither a slow machine nor other programs count.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from statistics import median
from typing import NamedTuple

_TURNS = 100_000


class Cost(NamedTuple):
    """Of one item of work.

    :param turns: of plain Python that take as long
    :param seconds: of processor time, on this machine
    """

    turns: float
    seconds: float

    @property
    def note(self) -> str:
        return f"{self.seconds * 1e6:.1f} µs here, {1 / self.seconds:,.0f}/s"


def turn_s() -> float:
    """Processor time of one turn, s."""
    begin = time.thread_time()
    for number in range(_TURNS):
        _turn(number)
    return (time.thread_time() - begin) / _TURNS


def _turn(number: int) -> int:
    return number * 31 & 0xFFFF


def cost(repeats: int, measure: Callable[[], float]) -> Cost:
    """The median of some measurements of the work, each between two of the yardstick.

    :param measure: processor time of one item, s
    """
    turns, seconds = [], []
    for _ in range(repeats):
        before = turn_s()
        seconds.append(measure())
        turns.append(seconds[-1] / ((before + turn_s()) / 2))
    return Cost(median(turns), median(seconds))
