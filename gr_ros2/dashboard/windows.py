"""Rates, ages and paths in bounded memory.

Invariants: each object holds a bounded number of items, for any length of its input. Times are seconds on one clock,
given by the caller, and never run backwards within one object.
"""

from __future__ import annotations

from collections import deque
from math import hypot

import numpy as np

from gr_ros2.core.arrays import Floats

Point = tuple[float, float]
RATE_S = 5.0
"""The window of all numbers called "now", s."""
_SLOTS = 20
"""Slots in a window of :class:`Rate`; the window moves by one slot at a time; memory is one item per slot."""
_SLOT_S = RATE_S / _SLOTS


class Rate:
    """Number and bytes of the events in the last ``RATE_S`` seconds."""

    def __init__(self) -> None:
        self._slots: deque[tuple[int, int, int]] = deque(maxlen=_SLOTS + 1)

    def add(self, now: float, size: int = 0) -> None:
        """Add one event of ``size`` bytes."""
        slot = int(now / _SLOT_S)
        if self._slots and self._slots[-1][0] >= slot:
            last, count, total = self._slots.pop()
            self._slots.append((last, count + 1, total + size))
        else:
            self._slots.append((slot, 1, size))

    def totals(self, now: float) -> tuple[int, int]:
        """Count and bytes in the window that ends now."""
        oldest = int(now / _SLOT_S) - (self._slots.maxlen or 1) + 1
        recent = [slot for slot in self._slots if slot[0] > oldest]
        return sum(slot[1] for slot in recent), sum(slot[2] for slot in recent)


class AgeMeter:
    """Age of information of one topic, exactly as :func:`gr_ros2_lab.record.metrics.age` computes it, kept as a sum."""

    def __init__(self) -> None:
        self._start: float | None = None
        self._since = self._newest = self._area = self._peak = 0.0

    def delivered(self, t_sent: float, now: float) -> None:
        """A message submitted at ``t_sent`` was delivered."""
        if self._start is None:
            self._start = self._since = now
            self._newest = t_sent
            return
        if t_sent > self._newest:
            self._area, self._peak = self._until(now)
            self._since, self._newest = max(now, self._since), t_sent

    def read(self, now: float) -> tuple[float, float, float] | None:
        """Age now, mean and peak since the first delivery, s; None before that."""
        if self._start is None:
            return None
        area, peak = self._until(now)
        length = max(now, self._since) - self._start
        return now - self._newest, area / length if length > 0 else now - self._newest, peak

    def _until(self, now: float) -> tuple[float, float]:
        low, high = self._since - self._newest, max(now, self._since) - self._newest
        return self._area + (low + high) / 2 * (high - low), max(self._peak, high)


class PathWindow:
    """The newest part of a path: points at a limited rate, and the exact end.

    :param points: most points kept
    :param apart_s: shortest time between two kept points, s
    """

    def __init__(self, points: int, apart_s: float) -> None:
        self._points: deque[tuple[float, float, float]] = deque(maxlen=points)
        self._apart_s = apart_s
        self.latest: Point | None = None

    def add(self, now: float, point: Point) -> None:
        """Add a point to the path."""
        self.latest = point
        if not self._points or now - self._points[-1][0] >= self._apart_s:
            self._points.append((now, *point))

    def xy(self) -> tuple[Floats, Floats]:
        """x and y of the kept points and of the exact end."""
        ends = [] if self.latest is None else [self.latest]
        points = np.array([*((x, y) for _, x, y in self._points), *ends], dtype=float).reshape(-1, 2)
        return points[:, 0], points[:, 1]


class PathComparison:
    """The path that one robot sent, the path that another robot received, and the error between them over time.

    The error at an instant is the distance between the position sent last and the position received last.

    :param points: most points of each path, and of the errors
    :param apart_s: shortest time between two points, s
    """

    def __init__(self, points: int, apart_s: float) -> None:
        self.sent = PathWindow(points, apart_s)
        self.received = PathWindow(points, apart_s)
        self._errors: deque[tuple[float, float]] = deque(maxlen=points)
        self._apart_s = apart_s

    def moved(self, now: float, point: Point) -> None:
        """The robot sent its position."""
        self.sent.add(now, point)
        self._compare(now)

    def heard(self, now: float, point: Point) -> None:
        """The other robot received a position."""
        self.received.add(now, point)

    def error(self) -> float | None:
        """The error now, m; None before both positions are known."""
        one, other = self.sent.latest, self.received.latest
        return None if one is None or other is None else hypot(one[0] - other[0], one[1] - other[1])

    def errors(self) -> tuple[Floats, Floats]:
        """Times in s and errors in m."""
        points = np.array(self._errors, dtype=float).reshape(-1, 2)
        return points[:, 0], points[:, 1]

    def _compare(self, now: float) -> None:
        error = self.error()
        if error is not None and (not self._errors or now - self._errors[-1][0] >= self._apart_s):
            self._errors.append((now, error))
