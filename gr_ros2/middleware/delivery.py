"""How most back-ends call back: one thread per participant, and a queue of bounded depth per subscription.

Invariants: everything that is called back runs in the participant's thread, one step after the other; of a full queue
the oldest message goes, and is counted; no step begins once ``close`` was called.
"""

from __future__ import annotations

import threading
from abc import abstractmethod
from collections import deque
from collections.abc import Callable, Sequence
from functools import partial

from gr_ros2.middleware.base import MessageCallback, Middleware, OffersCallback, Qos, Subscription


class CallbackThread:
    """The thread in which a participant calls back.

    :param middleware: whose it is, its domain known
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
        """Let the thread do something, after all it was asked for before; nothing once closed. From any thread."""
        with self._changed:
            if not self._closed:
                self._steps.append(step)
                self._changed.notify()

    def close(self) -> None:
        """Begin no further step, and wait a while for the one under way, unless called from it. Idempotent."""
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
    """A subscription whose messages wait until the participant's thread calls back with them.

    A back-end calls :meth:`push` with what it receives and :meth:`look` when publishers have come or gone.

    :param middleware: where messages are counted that do not reach the callback
    :param thread: where they are called back
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
        self._waiting: deque[bytes] = deque()
        self._queueing = threading.Lock()

    @abstractmethod
    def offers(self) -> Sequence[Qos]:
        """What the publishers found offer now."""

    @abstractmethod
    def leave(self) -> None:
        """Leave the graph; called once."""

    def push(self, payload: bytes) -> None:
        """Queue a message, from any thread."""
        if self.closed:
            return
        with self._queueing:
            full = bool(self._depth) and len(self._waiting) >= self._depth
            if full:
                self._waiting.popleft()
            self._waiting.append(payload)
        if full:
            text = f"{self.topic}: callbacks do not keep up, depth {self._depth} is full, the oldest go"
            self._participant.count_lost(self, self.topic, text)
        else:
            self._thread.call(self._take)

    def look(self) -> None:
        """Let those who follow hear what the publishers offer now, if that has changed. From any thread."""
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
                payload = self._waiting.popleft()
            if not self.closed:
                self._participant.deliver(self.topic, self._callback, payload)

    def _look(self) -> None:
        with self.calling:
            if not self.closed:
                self.found(self.offers())
