"""Processes that are forked from one that has loaded what they need, which each would do for a second."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import forkserver, get_context, resource_tracker

FORKS = get_context("forkserver")


def load_for_forks(*modules: str) -> None:
    """Begin to load modules in the process that is forked, unless it runs already. It ignores Ctrl-C, and so do its
    children: whoever waits for them ends them."""
    with interrupts_ignored():
        FORKS.set_forkserver_preload(list(modules))
        forkserver.ensure_running()


@contextmanager
def interrupts_ignored() -> Iterator[None]:
    """Processes and threads that are started inside ignore Ctrl-C. A terminal sends it to a whole process group."""
    resource_tracker.ensure_running()  # multiprocessing unblocks signals when it starts it, so it must already run
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
