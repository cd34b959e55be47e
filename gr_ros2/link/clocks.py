"""How far another robot's clock is ahead of this one's, from questions that it answers at once.

Invariants: no clock here, so the caller passes in the time. An answer tells the offset within half of its round trip,
since the way there and back may differ. The answer counts whose bound is the least, which grows as crystals drift. An
answer whose bounds lie outside of those replaces it, and shows that a clock was set if no adjustment explains it.
"""

from __future__ import annotations

from typing import NamedTuple

DRIFT = 5e-5
"""s per s by which two clocks drift apart at most, if nobody adjusts them."""
ADJUSTED = 5e-4
"""s per s by which a kernel adjusts a clock that is not set."""


class ClockOffset(NamedTuple):
    """What is known of another robot's clock.

    :param ahead_s: s by which it is ahead
    :param error_s: s by which that may be wrong
    :param jumps: how often it was set while it was watched
    :param jumped_s: by how much at last, s
    :param answers: how many have told it
    :param newest_s: what the newest of them alone tells, s
    :param newest_error_s: s by which that may be wrong
    :param newest_age_s: s since that came
    """

    ahead_s: float
    error_s: float
    jumps: int
    jumped_s: float
    answers: int
    newest_s: float
    newest_error_s: float
    newest_age_s: float

    @property
    def words(self) -> str:
        """By how much it is ahead, with the bound of the error."""
        return f"{self.ahead_s * 1e3:,.1f} ± {self.error_s * 1e3:,.1f} ms"


class _Answer(NamedTuple):
    ahead_s: float
    error_s: float
    at: float

    def earlier_by(self, by_s: float) -> _Answer:
        """The same, told by a clock that has been set forward since."""
        return self._replace(ahead_s=self.ahead_s - by_s)

    def error_at(self, now: float, rate: float) -> float:
        return self.error_s + rate * max(now - self.at, 0.0)


class OtherClock:
    """The clock of one other robot."""

    def __init__(self) -> None:
        self._best: _Answer | None = None
        self._newest: _Answer | None = None
        self._answers, self._jumps, self._jumped_s = 0, 0, 0.0

    def answered(self, ahead_s: float, round_trip_s: float, now: float) -> None:
        """An answer has come.

        :param ahead_s: offset, if the way there is as long as the way back
        :param round_trip_s: without the time for which the other robot held it
        """
        self._newest, best = _Answer(ahead_s, max(round_trip_s, 0.0) / 2, now), self._best
        self._answers += 1
        if best is not None:
            apart = abs(ahead_s - best.ahead_s) - self._newest.error_s
            if apart > best.error_at(now, ADJUSTED):
                self._jumps, self._jumped_s = self._jumps + 1, ahead_s - best.ahead_s
            elif best.error_at(now, DRIFT) < self._newest.error_s and apart <= best.error_at(now, DRIFT):
                return
        self._best = self._newest

    def own_was_set(self, by_s: float) -> None:
        """This robot's own clock was set forward by so many s."""
        if self._best is not None and self._newest is not None:
            self._best, self._newest = self._best.earlier_by(by_s), self._newest.earlier_by(by_s)

    def at(self, now: float) -> ClockOffset | None:
        """What is known now; None before the first answer."""
        best, newest = self._best, self._newest
        if best is None or newest is None:
            return None
        error_s = best.error_at(now, DRIFT)
        told = newest.ahead_s, newest.error_s, max(now - newest.at, 0.0)
        return ClockOffset(best.ahead_s, error_s, self._jumps, self._jumped_s, self._answers, *told)
