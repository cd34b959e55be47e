"""Processes that measure on all cores."""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context


def processes() -> ProcessPoolExecutor:
    """As many as there are cores, each with modules of its own."""
    return ProcessPoolExecutor(mp_context=get_context("forkserver"))
