"""The thread in which rclpy works for one participant.

Invariants: only this thread runs callbacks and destroys endpoints; no exception of a callback or of rclpy ends it: each
is counted, and the first of a kind is logged; nobody waits for work once it has ended.
"""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node

from gr_ros2.middleware.base import JOIN_S

_log = logging.getLogger(__name__)

TEND_PERIOD_S = 0.1
"""How often the participant is tended: rclpy has no callback for changes of the graph."""


class RclpyExecutor:
    """Runs a node, from now until ``close``, or until its context is shut down from outside.

    :param tend: called every ``TEND_PERIOD_S``, and when there is work; told whether rclpy has failed since the last
        call
    :param leave: called at the end, when no callback runs any more
    :param count: ``Middleware.count``
    :ivar group: callback group of all endpoints
    :ivar thread: in which it runs
    """

    def __init__(
        self,
        context: Context,
        node: Node,
        *,
        tend: Callable[[bool], None],
        leave: Callable[[], None],
        count: Callable[[str, str], None],
    ) -> None:
        self._tend_participant, self._leave, self._count = tend, leave, count
        self._lock = threading.Lock()
        self._open = True  # guarded by _lock: the node and its guard condition exist
        self._work: deque[tuple[Callable[[], None], threading.Event]] = deque()
        self._closing = threading.Event()
        self._failed = False
        # Reentrant; otherwise an error of rclpy while it takes a message would block the whole group permanently.
        self.group = ReentrantCallbackGroup()
        self._wake = node.create_guard_condition(self._tend, callback_group=self.group)
        # Steady, so that a paused simulation clock does not stop it.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        node.create_timer(TEND_PERIOD_S, self._tend, callback_group=self.group, clock=steady)
        self._executor = SingleThreadedExecutor(context=context)
        self._executor.add_node(node)
        self.thread = threading.Thread(target=self._spin, name="gr_ros2-rclpy", daemon=True)
        self.thread.start()

    @property
    def open(self) -> bool:
        """Whether it runs, and is not told to end."""
        return self._open and not self._closing.is_set()

    @property
    def closing(self) -> bool:
        """Whether it is told to end; no callback starts then."""
        return self._closing.is_set()

    def add(self, node: Node) -> None:
        """Run another node too."""
        self._executor.add_node(node)

    def remove(self, node: Node) -> None:
        """Run a node no more."""
        self._executor.remove_node(node)

    def run(self, work: Callable[[], None]) -> None:
        """Run work in the thread, and wait at most ``JOIN_S``; does nothing once the thread has ended, when everything
        is destroyed."""
        if threading.current_thread() is self.thread:
            work()
            return
        done = threading.Event()
        self._work.append((work, done))
        if self._trigger():
            done.wait(JOIN_S)

    def close(self) -> None:
        """Tell it to end. The caller waits for ``thread``."""
        self._closing.set()
        self._trigger()

    def _trigger(self) -> bool:
        """Wake the executor; False when it has ended."""
        with self._lock:
            if self._open:
                self._wake.trigger()
            return self._open

    def _tend(self) -> None:
        """In the thread: run queued work, then tend the participant."""
        while self._work:
            work, done = self._work.popleft()
            try:
                work()
            finally:
                done.set()
        failed, self._failed = self._failed, False
        self._tend_participant(failed)

    def _spin(self) -> None:
        try:
            while not self._closing.is_set():
                try:
                    self._executor.spin_once()
                except ExternalShutdownException:
                    _log.warning("rclpy: the context was shut down from outside; the middleware closes")
                    break
                except Exception as error:  # noqa: BLE001 - the thread must live on
                    self._count("executor_failed", f"rclpy failed in the executor: {type(error).__name__}: {error}")
                    _log.debug("in the executor", exc_info=True)
                    self._failed = True
                    self._closing.wait(0.01)  # a lasting error must not use the whole core
        finally:
            self._tear_down()

    def _tear_down(self) -> None:
        with self._lock:
            self._open = False
        self._executor.shutdown()
        self._leave()
        while self._work:
            self._work.popleft()[1].set()
