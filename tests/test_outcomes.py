"""What CI counts: tests that fail beside others and pass alone, which are few; a crash, which ends nothing."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.waiting import PATIENCE_S

ROOT = Path(__file__).resolve().parent.parent
TOOL = ROOT / "tools" / "repeat-failed"
PYTEST = [
    sys.executable,
    "-m",
    "pytest",
    "-q",
    "-p",
    "no:cacheprovider",
    "-p",
    "xdist.plugin",
    "-o",
    "markers=real_time",
]
BARE = {**os.environ, "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}
"""Runs of a few empty tests need no other plug-in, and each of five processes would load them all."""
CONFTEST = f"""
import sys
sys.path.insert(0, {str(ROOT)!r})
from tests.company import pytest_runtest_makereport, pytest_runtest_protocol
from tests.outcomes import (
    pytest_addoption,
    pytest_configure,
    pytest_runtest_logreport,
    pytest_xdist_make_scheduler,
)
"""
BEGIN = """
import os, signal
from pathlib import Path
import pytest

def once(name):
    path = Path(__file__).with_name(name)
    return not path.exists() and path.write_text("")is not None

@pytest.mark.parametrize("number", range(20))
def test_good(number): pass

@pytest.mark.skip
def test_skipped(): pass
"""
FLAKY = "def test_flaky_{0}(): assert not once('flaky_{0}')\n"
CRASH = "def test_crash():\n    if once('crash'): os.kill(os.getpid(), signal.SIGKILL)\n"
HANGING = "def test_hanging():\n    if once('hanging'): signal.pause()\n"
GROUPED = "@pytest.mark.xdist_group('radio')\n"


def judged(folder: Path, text: str, *options: str) -> tuple[int, list[str]]:
    """Run tests in two workers and repeat what failed: the status, and what was said of it."""
    (folder / "conftest.py").write_text(CONFTEST)
    (folder / "test_it.py").write_text(BEGIN + text)
    outcomes = folder / "outcomes"
    command = [*PYTEST, "-n", "2", "--dist", "loadgroup", f"--outcomes={outcomes}", *options]
    subprocess.run(command, cwd=folder, env=BARE, capture_output=True, timeout=PATIENCE_S, check=False)
    again = [TOOL, outcomes, *PYTEST, "-n", "0"]
    done = subprocess.run(again, cwd=folder, env=BARE, capture_output=True, text=True, check=False)
    said = [
        line for line in done.stdout.splitlines() if line.startswith(("repeated", "failed", "the run", "had begun"))
    ]
    said.sort()
    return done.returncode, [*said, done.stdout.splitlines()[-1]]


@pytest.mark.slow
def test_what_failed_or_crashed_once_is_named_and_counted_and_everything_else_runs(tmp_path: Path) -> None:
    assert judged(tmp_path, CRASH + GROUPED + FLAKY.format(1)) == (
        0,
        [
            "repeated: test_it.py::test_crash took its worker down beside other tests, and passed alone",
            "repeated: test_it.py::test_flaky_1 failed beside other tests, and passed alone",
            "22 passed, 0 failed",
        ],
    )


@pytest.mark.slow
def test_what_hangs_takes_its_worker_down_and_everything_else_runs(tmp_path: Path) -> None:
    at_once = ("-o", "faulthandler_timeout=1", "-o", "faulthandler_exit_on_timeout=true")
    assert judged(tmp_path, HANGING, *at_once) == (
        0,
        [
            "repeated: test_it.py::test_hanging took its worker down beside other tests, and passed alone",
            "21 passed, 0 failed",
        ],
    )


@pytest.mark.slow
def test_three_are_too_many_though_each_would_pass_alone(tmp_path: Path) -> None:
    status, said = judged(tmp_path, "".join(map(FLAKY.format, range(3))))
    assert status == 1
    assert said[:-1] == [f"failed: test_it.py::test_flaky_{n} failed" for n in range(3)]
    assert said[-1] == "20 passed, 3 failed"


BESIDE = """
import subprocess, sys, time
def beside_others():
    flag, other = (Path(__file__).with_name(name) for name in ("flag", "other.py"))
    flag.touch()
    text = "import os, time; end = time.time() + 30\\nwhile os.path.exists(%r) and time.time() < end: pass"
    other.write_text(text % str(flag))
    subprocess.run(["sh", "-c", f"setsid {sys.executable} {other} &"], check=True)  # nobody's child
    time.sleep(1)
    flag.unlink()
"""
LATE = """
@pytest.mark.real_time
def test_late_{0}():
    if once('late_{0}'):
        beside_others()
        assert 0, "too late"
"""


@pytest.mark.slow
def test_what_fails_in_real_time_beside_other_programs_is_late_and_repeated_alone(tmp_path: Path) -> None:
    status, said = judged(tmp_path, BESIDE + GROUPED + LATE.format(0))
    assert (status, said) == (
        0,
        ["repeated: test_it.py::test_late_0 was late beside other tests, and passed alone", "21 passed, 0 failed"],
    )


@pytest.mark.slow
def test_what_fails_alone_too_fails(tmp_path: Path) -> None:
    status, said = judged(tmp_path, "def test_bad(): assert 0\n")
    assert (status, said) == (1, ["failed: test_it.py::test_bad failed", "20 passed, 1 failed"])


@pytest.mark.slow
def test_a_run_that_did_not_come_to_its_end_fails(tmp_path: Path) -> None:
    status, said = judged(tmp_path, "def test_end(): pytest.exit('the end')\n", "-n", "0")
    assert status == 1
    assert said[:-1] == [
        "had begun and not ended: test_it.py::test_end",
        "the run did not come to its end: 1 of 22 tests have no result",
    ]
    status, said = judged(tmp_path, "import nothing_of_that_name\n")
    assert status == 1
    assert said == ["the run did not come to its end: 0 of 0 tests have no result", "0 passed, 0 failed"]
