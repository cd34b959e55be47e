"""How long something has stood still, as a watcher may say it who may have stood still himself.

A process that is frozen as a whole (docker pause, Ctrl-Z, a debugger) wakes up with every "last sign" that long ago. A
watcher that trusts the clock then accuses whatever it happens to look at first.

Invariant: an age never grows by more than one step from one look to the next, and never exceeds what the clock says.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from math import inf

LOOK_S = 1.0
"""s from one look to the next at most, of a watcher that has no period of its own."""


class Watch:
    """The age of the last sign of one thing, from looks that one watcher takes at it.

    :param step_s: s between two looks at most, while the watcher runs; more than that counts as so much
    """

    def __init__(self, step_s: float = LOOK_S) -> None:
        self._step = step_s
        self._age, self._looked = 0.0, inf
        self._count: object = None

    def age(self, told: float, now: float) -> float:
        """The age of the last sign, s, of which the watcher has seen every step.

        :param told: s since the last sign by the clock; inf where that is not known, but there was none since the last
            look
        :param now: s, monotonic
        """
        self._age = min(told, self._age + min(max(now - self._looked, 0.0), self._step))
        self._looked = now
        return self._age

    def still_s(self, count: object, now: float) -> float:
        """s for which a count has been the same; 0 for None."""
        changed = count is None or count != self._count
        self._count = count
        return self.age(0.0 if changed else inf, now)


def wait_until(
    over: Callable[[], object],
    timeout_s: float,
    pause: Callable[[float], object] = time.sleep,
    look_s: float = LOOK_S,
) -> bool:
    """Wait until something is over, for so many s of this process's own time at most.

    :param over: called again and again until it returns something true
    :param pause: waits for at most so many s
    :param look_s: s from one look to the next, ``LOOK_S`` at most
    :return: whether it was over in time
    """
    watch = Watch()
    while not over():
        if watch.age(inf, time.monotonic()) >= timeout_s:
            return False
        pause(min(look_s, timeout_s))
    return True
