"""Callbacks of most back-ends: one thread per participant, and a queue of bounded depth per subscription.

Invariants: all callbacks run in the participant's thread, one after the other; a full queue drops and counts its oldest
message; no step begins after ``close`` was called.
"""

from __future__ import annotations

import threading
import time
from abc import abstractmethod
from collections import deque
from collections.abc import Callable, Hashable, Sequence
from functools import partial

from gr_ros2.middleware.base import MessageCallback, Middleware, OffersCallback, Qos, Subscription


class CallbackThread:
    """The thread in which a participant calls back.

    :param middleware: the participant, whose domain is set
    :param node_name: of the participant, for the thread's name
    """

    def __init__(self, middleware: Middleware, node_name: str) -> None:
        self._middleware = middleware
        self._steps: deque[Callable[[], object]] = deque()
        self._changed = threading.Condition()
        self._closed = False
        name = f"{middleware.name}-{middleware.domain_id}-{node_name}"
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def call(self, step: Callable[[], object]) -> None:
        """Run a step in the thread, after all earlier steps; does nothing after ``close``. Any thread may call."""
        with self._changed:
            if not self._closed:
                self._steps.append(step)
                self._changed.notify()

    def close(self) -> None:
        """Start no further step, and wait up to ``JOIN_S`` for the current one, unless called from it. Idempotent."""
        with self._changed:
            self._closed = True
            self._steps.clear()
            self._changed.notify()
        self._middleware.wait_for_thread(self._thread)

    def _run(self) -> None:
        while True:
            with self._changed:
                while not self._steps and not self._closed:
                    self._changed.wait()
                if self._closed:
                    return
                step = self._steps.popleft()
            step()


class QueuedSubscription(Subscription):
    """A subscription whose messages wait until the participant's thread delivers them.

    A back-end calls :meth:`push` with each received message, and :meth:`look` when publishers have joined or left.

    :param middleware: counts messages that do not reach the callback
    :param thread: runs the callbacks
    :param topic: absolute name
    :param depth: messages that wait at most, 0 = unbounded
    """

    def __init__(
        self, middleware: Middleware, thread: CallbackThread, topic: str, depth: int, callback: MessageCallback
    ) -> None:
        super().__init__()
        self.topic = topic
        self.closed = False
        self._participant = middleware
        self._thread = thread
        self._depth = depth
        self._callback = callback
        self._waiting: deque[tuple[float, bytes, Hashable]] = deque()
        self._queueing = threading.Lock()

    @abstractmethod
    def offers(self) -> Sequence[Qos]:
        """The QoS of the publishers found now."""

    @abstractmethod
    def leave(self) -> None:
        """Leave the graph; called once."""

    def push(self, payload: bytes, source: Hashable = None) -> None:
        """Queue a message, from any thread.

        :param source: what tells its publisher apart from others
        """
        if self.closed:
            return
        with self._queueing:
            full = bool(self._depth) and len(self._waiting) >= self._depth
            if full:
                self._waiting.popleft()
            self._waiting.append((time.monotonic(), payload, source))
        if full:
            text = f"{self.topic}: callbacks do not keep up, depth {self._depth} is full, the oldest are dropped"
            self._participant.count_lost(self, self.topic, text)
        else:
            self._thread.call(self._take)

    def look(self) -> None:
        """Tell the followers the QoS of the publishers, if it has changed. Any thread may call."""
        self._thread.call(self._look)

    def follow(self, on_offers: OffersCallback) -> None:
        self.look()
        self._thread.call(partial(super().follow, on_offers))

    def close(self) -> None:
        if not self.closed:
            self.closed = True
            self.leave()
            self.wait_for_callback()

    def _take(self) -> None:
        with self.calling:
            with self._queueing:
                came, payload, self.source = self._waiting.popleft()
                self.waited_s = self._waiting[-1][0] - came if self._waiting else 0.0
            if not self.closed:
                self._participant.deliver(self.topic, self._callback, payload)

    def _look(self) -> None:
        with self.calling:
            if not self.closed:
                self.found(self.offers())
