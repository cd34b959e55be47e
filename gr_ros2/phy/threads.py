"""Settings for GNU Radio's scheduler: fast switching between Python threads, and message ports that lose nothing.

Invariants: a block keeps its thread's Python state from ``start`` to ``stop``, which GNU Radio calls in the thread that
also delivers its messages; no state of an ended thread is kept.
"""

from __future__ import annotations

import ctypes
import logging
import os
import sys
import threading
from abc import abstractmethod
from collections import deque
from collections.abc import Callable, Iterable
from functools import cached_property
from typing import Any, ClassVar

from gr_ros2.core.backends import uninterrupted
from gr_ros2.core.errors import PhyError

SWITCH_INTERVAL_S = 2e-3
"""Two busy Python threads wait a whole switch interval for each other at every hop. But who waits also wakes up once in
each interval: with 50 µs the demo's 50 threads switched 30,000 times a second, with this 11,000 times, and a computer
with a third of the processor time that the demo needs sends up to twice the packets (``python -m bench
slow_computer``). In the demo ages are the same with both, and with Python's default of 5 ms."""

_MAX_MESSAGES = "GR_CONF_DEFAULT_MAX_MESSAGES"
"""Environment variable of GNU Radio's setting ``max_messages``, read when a flowgraph starts."""

_LONGEST_WAIT_S = 3600.0
"""s after which a thread looks again at what is due later: with 300 years, which a rate may ask for, Python fails."""

_LOOK_S = 0.1
"""s between two checks: a thread that waits without a time limit may miss a signal."""

_START_ATTEMPTS = 20
"""GNU Radio maps each buffer twice in a row, and gives up when another thread maps memory at that place in between."""

_log = logging.getLogger(__name__)


def wait_until_s(at: float | None, now: float, least_s: float = 0.0) -> float | None:
    """The time to wait for what is due at ``at``, s, as a condition takes it; None where nothing is due."""
    return None if at is None else min(max(least_s, at - now), _LONGEST_WAIT_S)


def shorten_switch_interval() -> None:
    """Make Python switch between threads quickly; the setting is one for the whole process."""
    if sys.getswitchinterval() > SWITCH_INTERVAL_S:
        sys.setswitchinterval(SWITCH_INTERVAL_S)


def lift_message_limit() -> None:
    """Let message ports without a handler, such as that of ``pdu_to_tagged_stream``, keep every message.

    GNU Radio prunes such a port when it holds more than ``max_messages`` (8192), but it counts without a lock: although
    no more than 40 messages ever waited, it dropped about one in four million. A limit that is never reached turns this
    off. This affects flowgraphs started afterwards in this process; a value set by the user is kept.
    """
    os.environ.setdefault(_MAX_MESSAGES, "-1")


def start_flowgraph(start: Callable[[], None]) -> None:
    """Start a flowgraph, and try again if GNU Radio could not map a buffer.

    Ctrl-C is delayed until it has started, so that the caller can stop it.

    :raises PhyError: when GNU Radio fails after many attempts, or refuses the flowgraph
    """
    failed: Exception | None = None
    with uninterrupted():
        for _ in range(_START_ATTEMPTS):
            try:
                start()
                return
            except MemoryError as error:
                failed = error
                _log.debug("GNU Radio could not map a buffer; starting again")
            except RuntimeError as error:
                raise PhyError(f"the flowgraph does not start ({error})") from error
    raise PhyError(
        f"GNU Radio gets no shared memory for its buffers ({failed}); `ipcs -m` shows what there is: remove with ipcrm "
        "what programs have left, or raise kernel.shmmni"
    ) from failed


def wait_for_end(flowgraph: Any) -> None:
    """Wait until a flowgraph has finished.

    KeyboardInterrupt stops it and is raised. GNU Radio's own ``wait`` stops it too, but returns as if it had finished.
    """
    waiting = threading.Thread(target=flowgraph.wait, daemon=True)  # only the main thread receives signals
    try:
        with uninterrupted():
            waiting.start()
        while waiting.is_alive():
            waiting.join(_LOOK_S)
    except BaseException:
        flowgraph.stop()
        if waiting.ident is not None:  # the signal may come before the thread has started
            waiting.join()
        raise


def run_flowgraph(flowgraph: Any) -> None:
    """Start a flowgraph and wait until it has finished; see :func:`start_flowgraph` and :func:`wait_for_end`.

    It is stopped in any case: a flowgraph that is deleted while it runs waits for its threads with Python's lock held.
    """
    try:
        start_flowgraph(flowgraph.start)
        wait_for_end(flowgraph)
    except BaseException:
        flowgraph.stop()
        flowgraph.wait()
        raise


def log_warnings_only(blocks: Iterable[Any]) -> None:
    """Make these blocks log only warnings, not each buffer size."""
    for block in blocks:
        block.set_log_level("warn")


class ThreadState:
    """Keeps the Python state of the thread in which GNU Radio calls a block.

    Otherwise GNU Radio makes a state and ends it again with every message, and Python 3.11 and later map and unmap a
    stack with each: 10 µs per message, where a kept state takes 0.5 µs.
    """

    def __init__(self) -> None:
        self._ident: int | None = None
        self._state = 0

    def keep(self) -> None:
        """Call this in the block's ``start``; a second call does nothing."""
        if self._ident != threading.get_ident():
            self._ident = threading.get_ident()
            self._state = ctypes.pythonapi.PyGILState_Ensure()

    def release(self) -> None:
        """Call this in the block's ``stop``; it does nothing in any other thread than that of ``keep``."""
        if self._ident == threading.get_ident():
            self._ident = None
            ctypes.pythonapi.PyGILState_Release(self._state)


class BlockThread:
    """A thread that a Python block runs from its ``start`` to its ``stop``.

    Meanwhile the thread in which GNU Radio calls the block keeps its Python state, see :class:`ThreadState`.
    """

    def __init__(self) -> None:
        self._thread: threading.Thread | None = None
        self._state = ThreadState()

    def start(self, run: Callable[[], None], name: str) -> None:
        """Call this in the block's ``start``, once ``run`` would not return at once.

        :param run: what the thread does; not kept beyond its end, since blocks must not refer to themselves
        """
        shorten_switch_interval()
        self._state.keep()
        self._thread = threading.Thread(target=run, name=name, daemon=True)
        self._thread.start()

    @property
    def alive(self) -> bool:
        """Whether the thread runs."""
        return self._thread is not None and self._thread.is_alive()

    def stop(self, patience_s: float = 1.0) -> None:
        """Wait until ``run`` has returned. Call this in the block's ``stop``, after ``run`` has been told to return."""
        if self._thread is not None:
            self._thread.join(patience_s)
            self._thread = None
        self._state.release()


class WaitingBlock:
    """Mix-in for a Python block with a thread that waits for what changes; list it before GNU Radio's class.

    :param thread: name of the thread
    :param args: arguments of GNU Radio's class
    """

    def __init__(self, thread: str, *args: Any) -> None:
        super().__init__(*args)
        self._called = thread
        self._lock = threading.Lock()
        """What ``_changed`` waits with; to hold it by itself takes a quarter of the time."""
        self._changed = threading.Condition(self._lock)
        self._running = False
        self._thread = BlockThread()

    @abstractmethod
    def run(self) -> None:
        """What the thread does. It is woken by ``_changed``, and returns when ``_running`` is False."""

    def start(self) -> bool:
        """The flowgraph starts."""
        with self._changed:
            self._running = True
        self._thread.start(self.run, self._called)
        return True

    def stop(self) -> bool:
        """The flowgraph stops."""
        with self._changed:
            self._running = False
            self._changed.notify_all()
        self._thread.stop()
        return True


class KeepsThreadState:
    """Mix-in with start and stop for a Python block that needs nothing else there; list it before GNU Radio's class."""

    @cached_property
    def _thread_state(self) -> ThreadState:
        return ThreadState()

    def start(self) -> bool:
        """The flowgraph starts."""
        self._thread_state.keep()
        return True

    def stop(self) -> bool:
        """The flowgraph stops."""
        self._thread_state.release()
        return True


class KeptAlive(KeepsThreadState):
    """Mix-in for a Python block inside a hier block; list it before GNU Radio's class.

    GNU Radio calls Python blocks without holding a reference, so a flowgraph would crash after its creator dropped the
    hier block around them. This class keeps references until the blocks have stopped, and to the last few longer, since
    a flowgraph may start again; not to all, since a block keeps its input buffers.
    """

    _alive: ClassVar[set[Any]] = set()
    _stopped: ClassVar[deque[Any]] = deque(maxlen=32)

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self._alive.add(self)

    def start(self) -> bool:
        self._alive.add(self)
        return super().start()

    def stop(self) -> bool:
        self._alive.discard(self)
        self._stopped.append(self)
        return super().stop()
