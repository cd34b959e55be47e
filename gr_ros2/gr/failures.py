"""Failures of a block that must go on: each is counted by name, and the first of each name is logged."""

from __future__ import annotations

import logging
from collections import Counter
from typing import Any

from gr_ros2.core.errors import GrRos2Error


class Failures:
    """The counters of one block.

    :param lock: protects ``counters``
    """

    def __init__(self, log: logging.Logger, lock: Any) -> None:
        self.counters: Counter[str] = Counter()
        self._log, self._lock = log, lock

    def note(self, counter: str, what: str, error: Exception | None = None, *, level: int = logging.WARNING) -> None:
        """Count a failure and log the first one, with a traceback if the error is not one of this project."""
        with self._lock:
            self.counters[counter] += 1
            first = self.counters[counter] == 1
        if first:
            trace = None if isinstance(error, GrRos2Error) else error
            self._log.log(level, "%s%s", what, "" if error is None else f": {error}", exc_info=trace)
