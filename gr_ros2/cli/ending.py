"""How the program ends: its exit statuses, and what Ctrl-C, SIGTERM and a closed terminal do."""

from __future__ import annotations

import signal
from collections.abc import Callable

BAD_INPUT, FAILED, INTERRUPTED = 2, 1, 130


def on_signals(handler: Callable[..., object]) -> None:
    """Let Ctrl-C, SIGTERM and SIGHUP call ``handler``. A signal that is ignored from the start stays ignored."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, handler)
