"""Whether messages wait for the computer or for the air, by what credits say: what could have left and did not has
waited for the computer.

Invariants: time is an argument and never goes back; where no credit says since when the air is free, the computer is
taken for fast enough.
"""

from __future__ import annotations

from math import inf

from gr_ros2.link.pace import Pace

_WINDOW_S = 0.5
"""s over which it is found out whether the computer keeps up."""


class Slowness:
    """Of what one sending half runs on.

    :param pace: of that half
    """

    def __init__(self, pace: Pace) -> None:
        self._pace = pace
        self._idle, self._window = 0.0, -inf
        """s for which the PHY was idle although a message waited, since the begin of the window."""
        self.slow = False
        """Whether it was so for more than half of the last window."""

    def waited(self, since: float, now: float) -> None:
        """A message leaves that could have left since then, as far as it is known here."""
        if since < now and (could := max(since, self._pace.ready)) < now:
            self._idle += now - could
        if now - self._window >= _WINDOW_S:
            self.slow = self._idle > (now - self._window) / 2
            self._idle, self._window = 0.0, now

    def behind(self, now: float) -> bool:
        """Whether messages that wait do so because the computer is too slow, not the air."""
        return self.slow or (self._pace.credited and now - self._pace.ready > _WINDOW_S)
