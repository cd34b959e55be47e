"""Two clocks of this computer, read at one time."""

from __future__ import annotations

import time
from collections.abc import Callable
from math import inf

_READINGS, _AT_ONCE_S = 5, 1e-4
"""Readings at most, and s within which one counts as made at one time."""


def wall_ahead(clock: Callable[[], float] = time.monotonic, wall: Callable[[], float] = time.time) -> float:
    """How far the clock of the wall is ahead of another one, s.

    A thread that has to wait for the processor between two clocks is wrong by that, .1 s on a busy computer. So the
    reading counts that took least.
    """
    took_s, ahead = inf, 0.0
    for _ in range(_READINGS):
        before = clock()
        at = wall()
        after = clock()
        if after - before < took_s:
            took_s, ahead = after - before, at - (before + after) / 2
        if took_s <= _AT_ONCE_S:
            break
    return ahead
