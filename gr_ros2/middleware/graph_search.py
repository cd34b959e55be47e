"""A thread that looks at a ROS graph again and again, and spends only a small share of its time with it.

Invariant: one thread, which ends when it is closed, when its graph is closed, or with the process.
"""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod

from gr_ros2.core.errors import MiddlewareError


class GraphSearch(ABC):
    """Looks until it is closed. Looking may be slow: rclpy asks for every topic separately.

    :param name: of the thread
    :param least_s: s between two looks, at least
    :param share: largest share of time that may be spent looking
    """

    def __init__(self, name: str, least_s: float, share: float) -> None:
        self._least_s, self._share = least_s, share
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop looking. No callback begins after this has returned."""
        self._closed.set()
        if self._thread is not threading.current_thread():
            self._thread.join()

    @abstractmethod
    def _look(self) -> float:
        """Look once. Returns the s of it that do not count as looking.

        :raises MiddlewareError: when the graph is closed or cannot be asked; this ends the search
        """

    @abstractmethod
    def _failed(self, error: MiddlewareError) -> None:
        """Log the error that has ended the search."""

    def _run(self) -> None:
        try:
            while True:
                begin = time.monotonic()
                uncounted = self._look()
                spent = time.monotonic() - begin - uncounted
                if self._closed.wait(max(self._least_s, spent / self._share)):
                    return
        except MiddlewareError as error:
            self._failed(error)
