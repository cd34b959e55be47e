"""Work that may be done later: a bounded queue and one thread that processes it.

Invariants: :meth:`Backlog.offer` never waits, and refuses what does not fit; work is done in the order in which it
came, in one thread; a call that never returns delays only the work behind it.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from math import inf

from gr_ros2.core.watch import wait_until

_GATHER_S = 0.01
"""s that the thread collects work after it was woken. Waking it for every piece would cost the caller more than the
piece."""

Work = tuple[Callable[..., object], tuple[object, ...]]


class Backlog:
    """Does work in a thread of its own.

    :param name: name of the thread
    :param most: bytes that may wait or be in progress
    """

    def __init__(self, name: str, most: int) -> None:
        self._most = most
        self._changed = threading.Condition()
        self._waiting: list[Work] = []
        self._waiting_size = self._held = 0
        self._taken = self._done = 0
        self._idle = self._closed = False
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    @property
    def pending(self) -> int:
        """Pieces of work accepted and not done yet."""
        return self._taken - self._done

    def offer(self, size: int, work: Callable[..., object], *arguments: object) -> bool:
        """Hand over work, which must not raise.

        :param size: bytes that the work holds; work of 0 bytes always fits
        :return: whether the work was accepted: there was room, and the backlog is not closed
        """
        with self._changed:
            if self._closed or (size and self._held and self._held + size > self._most):
                return False
            self._take(size, (work, arguments))
        return True

    def put(self, size: int, work: Callable[..., object], *arguments: object) -> bool:
        """Hand over work like :meth:`offer`, but wait for room.

        :return: whether the work was accepted: the backlog is not closed
        """
        with self._changed:
            while self._held and self._held + size > self._most and not self._closed:
                self._changed.wait()
            if self._closed:
                return False
            self._take(size, (work, arguments))
        return True

    def settle(self, timeout_s: float) -> bool:
        """Wait until all accepted work is done.

        :return: whether it was done in time
        """
        with self._changed:
            return wait_until(lambda: not self.pending, timeout_s, self._changed.wait)

    def close(self, timeout_s: float | None = None) -> bool:
        """Accept no more work, and wait until all accepted work is done. Idempotent.

        :param timeout_s: None waits without limit
        :return: whether it was done in time
        """
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        if self._thread is not threading.current_thread():
            wait_until(lambda: not self._thread.is_alive(), inf if timeout_s is None else timeout_s, self._thread.join)
        return not self._thread.is_alive()

    def _take(self, size: int, work: Work) -> None:
        self._waiting.append(work)
        self._waiting_size += size
        self._held += size
        self._taken += 1
        if self._idle:
            self._idle = False
            self._changed.notify_all()

    def _run(self) -> None:
        while True:
            with self._changed:
                while not self._waiting:
                    if self._closed:
                        return
                    self._idle = True
                    self._changed.wait()
                self._idle = False
                hurry = self._closed
            if not hurry:
                time.sleep(_GATHER_S)
            with self._changed:
                batch, self._waiting = self._waiting, []
                size, self._waiting_size = self._waiting_size, 0
            for work, arguments in batch:
                work(*arguments)
                self._done += 1
            with self._changed:
                self._held -= size
                self._changed.notify_all()
