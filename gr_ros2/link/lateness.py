"""Measures how much later than due things happen, where a computer has to keep up with a clock.

Invariant: a delay of ``LATE_S`` or more is stored as an interval from the due time to the actual time. Intervals that
touch are merged, so their number is bounded by the time that has passed.
"""

from __future__ import annotations

LATE_S = 0.05
"""s. Smaller delays are normal on a system that shares its processor, and queues of a few packets absorb them."""


class Lateness:
    """The delays of one part of a run, recorded by one thread; other threads may read.

    :ivar worst: s, the longest delay
    :ivar moments: (due, happened), s on the caller's clock, in order of time
    """

    def __init__(self) -> None:
        self.worst = 0.0
        self.moments: list[tuple[float, float]] = []

    def happened(self, due: float, now: float) -> None:
        """Record that something that was due happens at ``now``. Calls must be in the order of the events."""
        late = now - due
        self.worst = max(self.worst, late)
        if late < LATE_S:
            return
        while self.moments and self.moments[-1][1] >= due:
            due = min(due, self.moments.pop()[0])
        self.moments.append((due, now))
