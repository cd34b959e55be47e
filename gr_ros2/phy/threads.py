"""The threads GNU Radio calls Python blocks from: made quick.

Laws: a block keeps its thread's state from ``start`` to ``stop``, which GNU Radio calls in the thread that also brings
its messages; nothing is kept of a thread that has ended.
"""

from __future__ import annotations

import ctypes
import sys
import threading

SWITCH_INTERVAL_S = 5e-5
"""Two busy Python threads wait a whole switch interval for each other at every hop: 10 ms per packet with Python's
default of 5 ms (two hops), 0.2 ms with this."""


def quicken_threads() -> None:
    """Let Python threads hand over quickly; for the whole process, since there is only one such setting."""
    if sys.getswitchinterval() > SWITCH_INTERVAL_S:
        sys.setswitchinterval(SWITCH_INTERVAL_S)


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
