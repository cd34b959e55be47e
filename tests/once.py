"""What is dear to make is made by one of xdist's workers, and the others take it."""

from __future__ import annotations

import fcntl
from collections.abc import Callable
from pathlib import Path

import pytest


def once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], None]) -> Path:
    """A folder of this run of the tests, filled by whichever worker comes first.

    :param name: of the folder, the same in all workers
    :param make: fills the empty folder; if it raises, the next worker tries again
    """
    base = factory.getbasetemp()
    root = base.parent if base.name.startswith("popen-") else base
    folder, unfinished = root / name, factory.mktemp(name)
    with (root / f"{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not folder.exists():
            make(unfinished)
            unfinished.rename(folder)
    return folder
