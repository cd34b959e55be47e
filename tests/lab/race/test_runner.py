from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from gr_ros2_lab.race.contenders import CONTENDERS
from tests.lab.race.support import needs_namespaces
from tests.programs import ProgramProcess, run_program
from tests.waiting import PATIENCE_S, wait_for

pytestmark = needs_namespaces

COMMAND = (sys.executable, "-m", "gr_ros2.cli", "race", "--short")


def descendants(pid: int) -> set[int]:
    """The processes a process has started, and those they have."""
    found: set[int] = set()
    for path in Path(f"/proc/{pid}/task").glob("*/children"):
        try:
            children = {int(child) for child in path.read_text().split()}
        except OSError:  # threads come and go
            continue
        found |= children.union(*map(descendants, children))
    return found


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


@pytest.mark.slow
@pytest.mark.real_time
def test_a_short_race_of_one_of_each_kind(tmp_path: Path) -> None:
    peers = ("gr-ros2", "gr-ros2-v0", "cyclone-best-effort", "zenoh-tcp")
    options = ("--peers", ",".join(peers), "--loss", "0", "--load", "50", "--duration", "2", "--out", str(tmp_path))
    done = run_program([*COMMAND, *options], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    values = json.loads((tmp_path / "race.json").read_text("utf-8"))
    cells = {cell["contender"]: cell for cell in values["cells"]}
    assert tuple(cells) == peers
    for name, cell in cells.items():
        assert cell["matched"], name
        assert cell["sent"] == 70, name
        assert cell["altered"] == cell["duplicates"] == 0, name
        assert cell["delivered"] >= 0.8 * cell["sent"], name  # a busy computer may cost some of the best-effort ones
        assert cell["air_bytes_per_message"] >= 50, name
        version_0 = "paper" in CONTENDERS[name].settings
        assert (cell["discovery_bytes"] == 0) == version_0, name
        assert (cell["air_bytes_reverse"] == 0) == version_0, name
        assert name in done.stdout
    assert "load 50%, loss 0%: ahead of gr-ros2: " in done.stdout
    assert "discovery bytes (gr-ros2-v0" in done.stdout
    assert cells["gr-ros2-v0"]["air_bytes_per_message"] < 100
    assert cells["gr-ros2"]["air_bytes_per_message"] < 100 < cells["zenoh-tcp"]["air_bytes_per_message"] < 500
    assert cells["cyclone-best-effort"]["air_bytes_per_message"] > 700


@pytest.mark.slow
@pytest.mark.real_time
def test_a_short_race_of_three_robots_on_one_channel(tmp_path: Path) -> None:
    peers = ("gr-ros2", "cyclone-best-effort", "zenoh-udp")
    options = ("--robots", "3", "--peers", ",".join(peers), "--loss", "0", "--load", "50", "--duration", "1")
    done = run_program([*COMMAND, *options, "--out", str(tmp_path)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    cells = {cell["contender"]: cell for cell in json.loads((tmp_path / "race.json").read_text("utf-8"))["cells"]}
    assert tuple(cells) == peers
    for name, cell in cells.items():
        assert cell["robots"] == 3
        assert cell["matched"], name
        assert cell["sent"] == 3 * 2 * 35, name
        assert cell["altered"] == cell["duplicates"] == 0, name
        assert cell["delivered"] >= 0.8 * cell["sent"], name
        assert cell["all_heard"] is not None, name
    # Cyclone sends a message once to both others, Zenoh over UDP to each.
    assert 350 < cells["cyclone-best-effort"]["air_bytes_per_message"] < 550
    assert cells["gr-ros2"]["air_bytes_per_message"] < 150 < cells["zenoh-udp"]["air_bytes_per_message"] < 300
    assert "3 robots on one channel, each with a topic such as /robot_1/odom" in done.stdout


@pytest.mark.slow
def test_ctrl_c_and_sudden_death_leave_no_process(tmp_path: Path) -> None:
    for how in (signal.SIGINT, signal.SIGKILL):
        with ProgramProcess(
            [*COMMAND, "--peers", "zenoh-udp", "--out", str(tmp_path / how.name)],
            stderr=subprocess.PIPE,
            env={**os.environ, "TMPDIR": str(tmp_path)},
        ) as process:
            wait_for(lambda pid=process.pid: len(descendants(pid)) >= 4, "no workers")  # type: ignore[misc]
            started = descendants(process.pid)
            process.send_signal(how)
            process.wait(PATIENCE_S)
            if how == signal.SIGINT:
                assert process.returncode == 130
            wait_for(lambda pids=started: not any(map(alive, pids)), "workers are left")  # type: ignore[misc]
