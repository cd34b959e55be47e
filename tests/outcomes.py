"""Pytest plugin: what became of every test, in a file; and a worker that crashed has a successor that ends.

Invariant: the file is written line by line, so it says as much as was known when a run is killed. A line is one word
and a test, as it is named on the command line: `collected`, `began`, then `passed`, `skipped`, `late` (see
`tests/company.py`), `failed` or `crashed`. A test that passes and cannot be cleaned up behind itself has two lines.
`tools/repeat-failed` reads it.
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from tests.company import LATE


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--outcomes", type=Path, metavar="FILE", help="write there what became of every test")


def pytest_configure(config: pytest.Config) -> None:
    path = config.getoption("--outcomes")
    if path is not None and not hasattr(config, "workerinput"):
        config.pluginmanager.register(Outcomes(path), "outcomes")


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """xdist's own for groups. Two errors of pytest-xdist 3.8 are corrected: waits without end after a worker's crash.

    What the worker had finished is given out again, as units of no test, and no answer to one ever comes. And a worker
    begins a test when it knows the next one, but the successor gets one unit only. Units are forgotten as they are
    finished, since each test that ends looks through all that its worker still has.
    """
    if config.getoption("dist") != "loadgroup":
        return None
    from xdist.scheduler import LoadGroupScheduling

    class Scheduler(LoadGroupScheduling):
        def mark_test_complete(self, node: Any, item_index: int, duration: float = 0) -> None:
            super().mark_test_complete(node, item_index, duration)
            scope = self._split_scope(self.registered_collections[node][item_index])
            if all(self.assigned_work[node][scope].values()):
                del self.assigned_work[node][scope]

        def schedule(self) -> None:
            super().schedule()
            super().schedule()

    return Scheduler(config, log)


class Outcomes:
    """Hooks of the process that has all results: the only one, or that of the workers."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("w", buffering=1)
        self._collected = False

    def pytest_collection_finish(self, session: pytest.Session) -> None:
        self._collect([item.nodeid for item in session.items])

    @pytest.hookimpl(optionalhook=True)
    def pytest_xdist_node_collection_finished(self, ids: Sequence[str]) -> None:
        self._collect(ids)

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        self._write("began", nodeid)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.when == "???":  # as xdist reports a worker that has ended
            self._write("crashed", report.nodeid)
        elif LATE in dict(report.user_properties):
            self._write("late", report.nodeid)
        elif report.when == "call" or report.outcome != "passed":
            self._write(report.outcome, report.nodeid)

    def pytest_sessionfinish(self) -> None:
        self._file.close()

    def _collect(self, ids: Sequence[str]) -> None:
        """Each worker collects the same."""
        if ids and not self._collected:
            self._collected = True
            for name in ids:
                self._write("collected", name)

    def _write(self, word: str, name: str) -> None:
        self._file.write(f"{word} {_pasted(name)}\n")


def _pasted(name: str) -> str:
    """The name of a test as pytest takes it, without the group that xdist appends."""
    return re.sub(r"@\w+$", "", name)


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """What the terminal shows can be pasted."""
    if not os.environ.get("PYTEST_XDIST_WORKER"):
        report.nodeid = _pasted(report.nodeid)
