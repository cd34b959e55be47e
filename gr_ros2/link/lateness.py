"""How much later than due things happen, where a computer has to keep up with a clock.

Invariant: what was late by ``LATE_S`` or more is kept as a moment, from when it was due until it happened; moments that
touch are one, so that there are no more than the time that passes has room for.
"""

from __future__ import annotations

LATE_S = 0.05
"""s. Less is what any system that shares its processor does now and then, and what queues of a few packets carry."""


class Lateness:
    """Of one part of a run, by one thread; others may read.

    :ivar worst: s, the most that anything was late
    :ivar moments: (due, happened), s on the caller's clock, by time
    """

    def __init__(self) -> None:
        self.worst = 0.0
        self.moments: list[tuple[float, float]] = []

    def happened(self, due: float, now: float) -> None:
        """Something that was due happens at ``now``; in the order in which things happen."""
        late = now - due
        self.worst = max(self.worst, late)
        if late < LATE_S:
            return
        while self.moments and self.moments[-1][1] >= due:
            due = min(due, self.moments.pop()[0])
        self.moments.append((due, now))
