"""Settings of every test."""

from __future__ import annotations

import gc
import os
import signal
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings

# Workers share the cores: threads of theirs for linear algebra would only wait for each other. Read as numpy is loaded.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from gr_ros2_lab.record.result import Result
from tests import domains
from tests.company import pytest_runtest_makereport, pytest_runtest_protocol  # noqa: F401
from tests.lab.record.results import RESULT
from tests.missing import pytest_pycollect_makemodule  # noqa: F401
from tests.outcomes import (  # noqa: F401
    pytest_addoption,
    pytest_configure,
    pytest_runtest_logreport,
    pytest_xdist_make_scheduler,
)

# Helpers that assert say what they saw, as tests do.
pytest.register_assert_rewrite("tests.e2e.support", "tests.middleware.support", "tests.waiting")

# Machines are shared and noisy: no example has a deadline. CI draws the same examples each time, so that a red run
# means a change; `make test` elsewhere draws new ones.
# 40 of each are enough to meet a mistake of today; `--hypothesis-profile=thorough` looks for what is rare.
settings.register_profile("here", deadline=None, max_examples=40)
settings.register_profile("ci", deadline=None, max_examples=40, derandomize=True)
settings.register_profile("thorough", deadline=None, max_examples=2000)
settings.load_profile("ci" if os.environ.get("CI") else "here")

# A test that names no domain is on one of this process's own, and tests never meet robots on the network.
os.environ.update(ROS_DOMAIN_ID=str(domains.domain()), ROS_LOCALHOST_ONLY="1")
# What a person has set for their own robots is not for tests.
for name in (
    "CYCLONEDDS_URI",
    "FASTRTPS_DEFAULT_PROFILES_FILE",
    "ROS_AUTOMATIC_DISCOVERY_RANGE",
    "ROS_STATIC_PEERS",
    "ZENOH_CONFIG_OVERRIDE",
    "ZENOH_SESSION_CONFIG_URI",
):
    os.environ.pop(name, None)

# Programs write in blocks to what is no terminal, as they do for most people.
os.environ.pop("PYTHONUNBUFFERED", None)

# Tests start hundreds of programs. Each would compile the package, and list the fonts where a test has its own home.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False
os.environ.setdefault(
    "MPLCONFIGDIR", str(Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "matplotlib")
)

# Robots of tests count their starts where nobody else's do.
_STATE = tempfile.TemporaryDirectory(prefix="gr_ros2-state-")
os.environ["XDG_STATE_HOME"] = _STATE.name

# A shell script's background jobs ignore Ctrl-C, and so would every program that a test starts and interrupts.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


GROUPS = {
    "real_time": "radios that the processor must keep up with",
    "browser": "one Chromium",
    "cluster": "Dask with two workers",
    "installed": "a wheel and a virtual environment",
    "platform": "GRC with all its blocks",
    "walked": "the commands of a page, one after another",
    "arm": "kernels compiled for ARM",
}
"""Fixtures that are dear to make, and markers: tests that share one run one after another, in one worker."""


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers() -> int:
    """Workers of ``-n auto``: two more than cores, since tests often wait: two groups in real time for radios and for
    pages, others for programs.

    Each worker imports everything once, and tests in real time suffer from more: with five on two cores, all took a
    quarter more of the processors' time, and longer.
    """
    return len(os.sched_getaffinity(0)) + 2


@pytest.hookimpl(tryfirst=True)  # before xdist reads the groups
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """In several processes, groups stay together, and slow tests begin first, so that none is waited for at the end;
    groups of many tests begin first by xdist's own order."""
    if not config.pluginmanager.hasplugin("xdist"):
        return
    for item in items:
        names = {mark.name for mark in item.iter_markers()} | set(getattr(item, "fixturenames", ()))
        for name in GROUPS.keys() & names:
            item.add_marker(pytest.mark.xdist_group(name))
    if os.environ.get("PYTEST_XDIST_WORKER"):
        items.sort(key=lambda item: item.get_closest_marker("slow") is None)


def pytest_make_parametrize_id(val: object, argname: str) -> str | None:
    """Long values are named by their length: every worker tells the names of all tests, once megabytes of pixels."""
    return f"{argname}_of_{len(val)}" if isinstance(val, (bytes, str)) and len(val) > 99 else None


@pytest.hookimpl(hookwrapper=True)
def pytest_collection() -> Iterator[None]:
    """Modules and tests live to the end, so the garbage collector need not look at them: a third of the time here.

    What a test records lives as long as the test, so it is looked at more rarely than by default: a tenth of the time
    of tests of engines otherwise.
    """
    gc.disable()
    yield
    gc.freeze()
    gc.set_threshold(100_000)
    gc.enable()


def pytest_sessionfinish() -> None:
    """Pytest then collects garbage five times, which takes seconds where a thousand tests have been."""
    gc.freeze()


def pytest_collection_finish(session: pytest.Session) -> None:
    """xdist groups by what it appends to a test's name; pytest 9.2 ignores that, and radios would run side by side."""
    grouped = [item for item in session.items if item.get_closest_marker("xdist_group")]
    if session.config.getoption("loadgroup", default=False) and not all("@" in item.nodeid for item in grouped):
        raise pytest.UsageError(
            f"pytest-xdist does not group tests with pytest {pytest.__version__}: install requirements-dev.txt"
        )


@pytest.fixture(autouse=True)
def _domains_of_one_test() -> Iterator[None]:
    """DDS domains are a test's own until it ends."""
    yield
    domains.give_back()


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Figures of reports stay empty files, for tests of what stands around them: drawing takes most of the time."""

    def empty(_figure: object, directory: str | Path, name: str, largest_svg: int = 0) -> list[Path]:
        files = [Path(directory) / f"{name}.{kind}" for kind in (("svg",) if largest_svg else ("png", "svg"))]
        Path(directory).mkdir(parents=True, exist_ok=True)
        for file in files:
            file.write_text("<svg/>")
        return files

    monkeypatch.setattr("gr_ros2_lab.report.page.save_figure", empty)


@pytest.fixture
def result() -> Result:
    """One topic with numbers and one on which nothing was sent."""
    return RESULT
