"""What GNU Radio's scheduler needs to be told: quick threads for Python blocks, and message ports that lose nothing.

Laws: a block keeps its thread's state from ``start`` to ``stop``, which GNU Radio calls in the thread that also brings
its messages; nothing is kept of a thread that has ended.
"""

from __future__ import annotations

import ctypes
import os
import sys
import threading

SWITCH_INTERVAL_S = 5e-5
"""Two busy Python threads wait a whole switch interval for each other at every hop: 10 ms per packet with Python's
default of 5 ms (two hops), 0.2 ms with this."""

_MAX_MESSAGES = "GR_CONF_DEFAULT_MAX_MESSAGES"
"""Environment variable of GNU Radio's setting ``max_messages``, read when a flowgraph starts."""


def quicken_threads() -> None:
    """Let Python threads hand over quickly; for the whole process, since there is only one such setting."""
    if sys.getswitchinterval() > SWITCH_INTERVAL_S:
        sys.setswitchinterval(SWITCH_INTERVAL_S)


def keep_messages() -> None:
    """Let message ports without a handler, such as that of ``pdu_to_tagged_stream``, keep every message.

    GNU Radio prunes such a port when it holds more than ``max_messages`` (8192), but counts without a lock: with no
    more than 40 messages ever waiting it dropped about one in four million. A limit that is never reached turns
    that off. For flowgraphs started afterwards in this process; a setting of the user's own stays.
    """
    os.environ.setdefault(_MAX_MESSAGES, "-1")


class BlockThread:
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
