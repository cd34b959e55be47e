"""Pytest plugin: a test in real time that fails while other programs take the processors is late, not failed.

Such a test (marker ``real_time``) needs a computer that keeps up with a radio's clock. While it runs, the processor
time of all programs is measured but that of its own process and of what this has started. Where others took more than
``ALLOWED`` of a processor, a failure says nothing of the code: the test is skipped, with that and with what had failed
as its reason, and `tests/outcomes.py` counts it apart. `tools/repeat-failed` repeats it alone, with
``GR_ROS2_ALONE=1``: then a failure is one.
"""

from __future__ import annotations

import os
import time
from collections.abc import Generator
from pathlib import Path

import pytest

ALLOWED = 0.25
"""Processors that others may use. What a system does by itself is less."""
LATE = "late"
"""Name of the property that a report of such a test has."""

_STAT = Path("/proc/stat")
_STARTED = pytest.StashKey[tuple[float, float]]()


def busy_s() -> float:
    """Processor time of all programs since the computer started, s, and what other machines took from it."""
    user, nice, system, _, _, irq, soft_irq, steal, *_ = map(int, _STAT.read_text().splitlines()[0].split()[1:])
    return (user + nice + system + irq + soft_irq + steal) / os.sysconf("SC_CLK_TCK")


def own_s() -> float:
    """Processor time of this process and of all that it has started, s."""
    parents: dict[int, int] = {}
    used: dict[int, int] = {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            fields = (folder / "stat").read_text().rpartition(")")[2].split()
        except OSError:
            continue  # it has ended
        parents[int(folder.name)] = int(fields[1])
        used[int(folder.name)] = sum(map(int, fields[11:15]))  # its own, and of those that it has waited for
    own = {os.getpid()}
    while more := {pid for pid, parent in parents.items() if parent in own and pid not in own}:
        own |= more
    return sum(used.get(pid, 0) for pid in own) / os.sysconf("SC_CLK_TCK")


def others_s() -> float:
    """Processor time of all other programs, s."""
    return busy_s() - own_s()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    if item.get_closest_marker("real_time") and _STAT.exists() and not os.environ.get("GR_ROS2_ALONE"):
        item.stash[_STARTED] = time.monotonic(), others_s()
    return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item,
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    report = yield
    if report.failed and report.when != "teardown" and _STARTED in item.stash:
        since, before = item.stash[_STARTED]
        used = (others_s() - before) / max(time.monotonic() - since, 1e-3)
        if used > ALLOWED:
            path, line, _ = item.location
            why = f"other programs used {used:.1f} of {os.cpu_count()} processors, and this failed: {_first(report)}"
            report.outcome, report.longrepr = "skipped", (path, line or 0, f"Skipped: {why}")
            report.user_properties.append((LATE, used))
    return report


def _first(report: pytest.TestReport) -> str:
    """What failed, in a line."""
    text = report.longreprtext
    return next((line[1:].strip() for line in text.splitlines() if line.startswith("E ")), text[-200:])
