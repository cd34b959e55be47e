"""How tests wait: for a condition, never for a time."""

from __future__ import annotations

import time
from collections.abc import Callable

PATIENCE_S = 120.0
"""s after which a condition counts as failed: only a hang takes that long, also on a busy machine."""

_SHORTEST_S, _LONGEST_S = 0.001, 0.02
"""Pauses between two looks; they grow, so that waiting leaves the processor to what is waited for."""


def wait_for(condition: Callable[[], object], what: str = "condition") -> None:
    """Return once a condition holds.

    :param condition: called again and again until it returns something true
    :param what: is waited for, as the failure says it
    :raises AssertionError: it does not hold in time, which fails the test
    """
    end = time.monotonic() + PATIENCE_S
    pause = _SHORTEST_S
    while not condition():
        assert time.monotonic() < end, f"waited {PATIENCE_S:g} s for {what}"
        time.sleep(pause)
        pause = min(2 * pause, _LONGEST_S)
