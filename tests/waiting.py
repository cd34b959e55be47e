"""How tests wait: for a condition, never for a time.

Invariant: patience ends a hang and nothing else. It is far longer than anything here takes on a slow computer. Where
work takes long by itself, patience begins anew with each step of that work.
"""

from __future__ import annotations

import time
from collections.abc import Callable

PATIENCE_S = 300.0
"""s without progress after which a condition counts as failed; also the timeout of whatever takes one."""

_SHORTEST_S, _LONGEST_S = 0.001, 0.05
"""Pauses between two looks; they grow, so that waiting leaves the processor to what is waited for."""
_RESTS = 3.0
"""How many times as long as a look the pause after it is at least; statistics of a link took a third of some tests."""
_REST_S = 0.5
"""The longest such pause, s: on a busy computer a look takes long."""
_PROGRESS_S = 1.0
"""s between two looks at progress."""


def wait_for(
    condition: Callable[[], object],
    what: str = "condition",
    progress: Callable[[], object] | None = None,
    longest_s: float = _LONGEST_S,
) -> None:
    """Return once a condition holds.

    :param condition: called again and again until it returns something true
    :param what: is waited for, as the failure says it
    :param progress: called each second; while what it returns changes, patience begins anew
    :param longest_s: the longest pause between two looks that take no time
    :raises AssertionError: it does not hold in time, which fails the test
    """
    now = looked = time.monotonic()
    end = now + PATIENCE_S
    pause = _SHORTEST_S
    reached: object = None
    while not condition():
        took = time.monotonic() - now
        if progress is not None and now >= looked + _PROGRESS_S:
            looked = now
            if (step := progress()) != reached:
                reached, end = step, now + PATIENCE_S
        if now > end:
            where = "" if progress is None else f", the last step of it {reached}"
            raise AssertionError(f"waited {PATIENCE_S:g} s for {what}{where}")
        time.sleep(max(pause, min(_RESTS * took, _REST_S)))
        pause = min(2 * pause, longest_s)
        now = time.monotonic()
