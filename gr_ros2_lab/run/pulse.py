"""Measures how late the threads of this process are scheduled: one thread wakes up periodically and checks the time.

Invariant: the thread does nothing else, so its lateness is caused by the computer, which is busy with other programs or
with other threads of this one.
"""

from __future__ import annotations

import threading
import time

from gr_ros2.link.lateness import Lateness

PERIOD_S = 0.02


class Pulse:
    """A thread that measures from ``start`` to ``close``."""

    def __init__(self) -> None:
        self.lateness = Lateness()
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._beat, name="gr-ros2-pulse", daemon=True)

    def start(self) -> None:
        """Begin. To be called only once."""
        self._thread.start()

    def close(self) -> None:
        """End. Idempotent; may also be called before the start."""
        self._over.set()
        if self._thread.ident is not None:
            self._thread.join()

    def _beat(self) -> None:
        while True:
            due = time.monotonic() + PERIOD_S
            if self._over.wait(PERIOD_S):
                return
            self.lateness.happened(due, time.monotonic())
