"""What GNU Radio's scheduler needs to be told: quick threads for Python blocks, and message ports that lose nothing.

Invariants: a block keeps its thread's state from ``start`` to ``stop``, which GNU Radio calls in the thread that also
brings its messages; nothing is kept of a thread that has ended.
"""

from __future__ import annotations

import ctypes
import logging
import os
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterable
from functools import cached_property
from typing import Any, ClassVar

from gr_ros2.backends import uninterrupted
from gr_ros2.errors import PhyError

SWITCH_INTERVAL_S = 5e-5
"""Two busy Python threads wait a whole switch interval for each other at every hop: 10 ms per packet with Python's
default of 5 ms (two hops), 0.2 ms with this."""

_MAX_MESSAGES = "GR_CONF_DEFAULT_MAX_MESSAGES"
"""Environment variable of GNU Radio's setting ``max_messages``, read when a flowgraph starts."""

_LOOK_S = 0.1
"""A thread that waits without end does not always hear a signal."""

_START_ATTEMPTS = 20
"""GNU Radio maps each buffer twice in a row, and gives up when another thread maps memory at that place in between."""

_log = logging.getLogger(__name__)


def shorten_switch_interval() -> None:
    """Let Python threads hand over quickly; for the whole process, since there is only one such setting."""
    if sys.getswitchinterval() > SWITCH_INTERVAL_S:
        sys.setswitchinterval(SWITCH_INTERVAL_S)


def lift_message_limit() -> None:
    """Let message ports without a handler, such as that of ``pdu_to_tagged_stream``, keep every message.

    GNU Radio prunes such a port when it holds more than ``max_messages`` (8192), but counts without a lock: with no
    more than 40 messages ever waiting it dropped about one in four million. A limit that is never reached turns
    that off. For flowgraphs started afterwards in this process; a setting of the user's own stays.
    """
    os.environ.setdefault(_MAX_MESSAGES, "-1")


def start_flowgraph(start: Callable[[], None]) -> None:
    """Start a flowgraph, again and again where GNU Radio could not map a buffer.

    Ctrl-C waits until it has started: who calls can stop it then.

    :raises PhyError: when it still cannot after many attempts, or refuses the flowgraph
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
    """Wait until a flowgraph has come to its end.

    KeyboardInterrupt stops it and comes through. GNU Radio's own ``wait`` stops it too, but returns as if all
    of it had passed.
    """
    waiting = threading.Thread(target=flowgraph.wait, daemon=True)  # signals reach the main thread alone
    try:
        with uninterrupted():
            waiting.start()
        while waiting.is_alive():
            waiting.join(_LOOK_S)
    except BaseException:
        flowgraph.stop()
        waiting.join()
        raise


def run_flowgraph(flowgraph: Any) -> None:
    """Start a flowgraph and wait until it has come to its end; see :func:`start_flowgraph` and :func:`wait_for_end`.

    Whatever happens it is stopped: one that is let go while it runs waits for its threads with Python's lock held.
    """
    try:
        start_flowgraph(flowgraph.start)
        wait_for_end(flowgraph)
    except BaseException:
        flowgraph.stop()
        flowgraph.wait()
        raise


def log_warnings_only(blocks: Iterable[Any]) -> None:
    """Let these blocks log warnings only, not each buffer set on them."""
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
        """To be called in the block's ``start``; harmless when called twice."""
        if self._ident != threading.get_ident():
            self._ident = threading.get_ident()
            self._state = ctypes.pythonapi.PyGILState_Ensure()

    def release(self) -> None:
        """To be called in the block's ``stop``; does nothing in any other thread than that of ``keep``."""
        if self._ident == threading.get_ident():
            self._ident = None
            ctypes.pythonapi.PyGILState_Release(self._state)


class KeepsThreadState:
    """Start and stop of a Python block that has nothing else to do there; stands before GNU Radio's class."""

    @cached_property
    def _thread_state(self) -> ThreadState:
        return ThreadState()

    def start(self) -> bool:
        self._thread_state.keep()
        return True

    def stop(self) -> bool:
        self._thread_state.release()
        return True


class KeptAlive(KeepsThreadState):
    """A Python block inside a hier block; stands before GNU Radio's class.

    GNU Radio calls Python blocks without holding a reference, so a flowgraph whose maker dropped the hier block around
    them would crash. They are held here until they have stopped, and a while longer, since a flowgraph may start again;
    not for ever, since a block holds the buffers in front of it.
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
