"""Programs out of the nursery are like others to who starts them."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from gr_ros2.core.errors import RunError
from gr_ros2_lab.race.namespaces import Namespace, check_means, inside
from tests.programs import ANEW, ProgramProcess, run_program

pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")

SHOW = """
import json, os, sys, threading
words = sys.stdin.read() if "-" in sys.argv else ""
print(json.dumps({"words": sys.argv[1:], "folder": os.getcwd(), "env": os.environ.get("MARK"), "given": words,
    "parent": os.getppid(), "session": os.getsid(0) == os.getpid(), "loaded": "gnuradio" in sys.modules,
    "name": __name__}))
print("trouble", file=sys.stderr)
sys.exit(7)
"""
WAIT = "import time\nprint('ready', flush=True)\ntime.sleep(1000)\n"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Where two modules are that ``python -m`` finds, since they are in the folder in which it runs."""
    (tmp_path / "show.py").write_text(SHOW)
    (tmp_path / "wait.py").write_text(WAIT)
    (tmp_path / "fail.py").write_text("raise ValueError('broken')")
    return tmp_path


def test_a_program_has_what_it_is_given(folder: Path) -> None:
    env = {**os.environ, "MARK": "ä"}
    command = [sys.executable, "-m", "show", "-", "a b"]
    options = {"cwd": folder, "env": env, "capture_output": True, "text": True, "input": "in\n"}
    done = run_program(command, start_new_session=True, **options)
    assert (done.returncode, done.stderr) == (7, "trouble\n")
    assert json.loads(done.stdout) == {
        **{"words": ["-", "a b"], "folder": str(folder), "env": "ä", "given": "in\n", "parent": os.getpid()},
        **{"session": True, "loaded": True, "name": "__main__"},
    }
    with pytest.raises(subprocess.CalledProcessError):
        run_program(command, check=True, **options)


def test_an_error_is_told_as_by_any_program(folder: Path) -> None:
    done = run_program([sys.executable, "-m", "fail"], cwd=folder, capture_output=True, text=True)
    assert done.returncode == 1
    assert done.stderr.endswith("ValueError: broken\n")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_signals_end_it(folder: Path, number: signal.Signals) -> None:
    command = [sys.executable, "-m", "wait"]
    with ProgramProcess(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        process.send_signal(number)
        assert process.wait() == -number
        with pytest.raises(ProcessLookupError):
            os.kill(process.pid, 0)


def test_what_matters_as_python_begins_begins_anew(folder: Path) -> None:
    plain = {"cwd": folder, "capture_output": True, "text": True}
    for command, env in (
        ([*ANEW, "show"], None),
        ([sys.executable, "-m", "show"], {**os.environ, "HOME": str(folder)}),
    ):
        done = run_program(command, env=env, **plain)
        assert json.loads(done.stdout)["loaded"] is False


def test_a_thread_in_another_network_namespace_starts_its_programs_there(folder: Path) -> None:
    try:
        check_means()
    except RunError as error:
        pytest.skip(str(error))
    command = [sys.executable, "-m", "show"]
    run_program(command, cwd=folder, capture_output=True)  # the nursery is here already
    with Namespace() as namespace:
        done = inside(namespace.path, lambda: run_program(command, cwd=folder, capture_output=True, text=True))
    assert json.loads(done.stdout)["loaded"] is False
