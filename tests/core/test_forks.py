"""Processes that are forked: Ctrl-C does not reach them, and they have what was loaded for them."""

from __future__ import annotations

import json
import signal
import sys
from pathlib import Path

from tests.programs import run_program

MODULE = """
import json, signal, sys
from gr_ros2.core.forks import FORKS, load_for_forks

def look(line):
    line.send(["wave" in sys.modules, signal.SIGINT in signal.pthread_sigmask(0, [])])

if __name__ == "__main__":
    load_for_forks("wave")
    load_for_forks("of_no_use_as_it_runs")
    ours, theirs = FORKS.Pipe()
    child = FORKS.Process(target=look, args=(theirs,))
    child.start()
    print(json.dumps(ours.recv()))
    child.join()
    print(json.dumps(signal.SIGINT in signal.pthread_sigmask(0, [])))
"""


def test_a_child_has_what_was_loaded_and_ignores_ctrl_c_and_its_owner_does_not(tmp_path: Path) -> None:
    (tmp_path / "owner.py").write_text(MODULE)
    done = run_program([sys.executable, "-m", "owner"], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert [json.loads(line) for line in done.stdout.splitlines()] == [[True, True], False]
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, [])
