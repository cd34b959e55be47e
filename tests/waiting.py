"""How tests wait: for a condition, never for a time.

Invariant: patience ends a hang and nothing else. It is far longer than anything here takes on a slow computer. Where
work takes long by itself, patience begins anew with each step of that work.
"""

from __future__ import annotations

import time
from collections.abc import Callable

PATIENCE_S = 300.0
"""s without progress after which a condition counts as failed; also the timeout of whatever takes one."""

_SHORTEST_S, _LONGEST_S = 0.001, 0.02
"""Pauses between two looks; they grow, so that waiting leaves the processor to what is waited for."""


def wait_for(
    condition: Callable[[], object],
    what: str = "condition",
    progress: Callable[[], object] | None = None,
    longest_s: float = _LONGEST_S,
) -> None:
    """Return once a condition holds.

    :param condition: called again and again until it returns something true
    :param what: is waited for, as the failure says it
    :param progress: called after each look; while what it returns changes, patience begins anew
    :param longest_s: the longest pause between two looks, where a look is dear
    :raises AssertionError: it does not hold in time, which fails the test
    """
    end = time.monotonic() + PATIENCE_S
    pause = _SHORTEST_S
    reached: object = None
    while not condition():
        if progress is not None and (now := progress()) != reached:
            reached, end = now, time.monotonic() + PATIENCE_S
        if time.monotonic() > end:
            where = "" if progress is None else f", the last step of it {reached}"
            raise AssertionError(f"waited {PATIENCE_S:g} s for {what}{where}")
        time.sleep(pause)
        pause = min(2 * pause, longest_s)
