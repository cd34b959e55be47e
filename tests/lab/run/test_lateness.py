"""A run on a computer that does not keep up says so: here the computer really stands still for a while."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from gr_ros2_lab.record.result import Result, read_result
from gr_ros2_lab.record.trace import read_trace
from gr_ros2_lab.report.explain import explanation
from gr_ros2_lab.run.runner import PERIOD_S, Pulse
from tests.domains import free_domains
from tests.waiting import wait_for

ROOT = Path(__file__).parents[3]
STOPPED_S = 0.5
PROGRAM = """
import json, sys
from pathlib import Path
from gr_ros2_lab.run.runner import run_scenario
from gr_ros2_lab.run.scenario import load_scenario
from tests.said import say

overrides, out = json.loads(sys.argv[1]), Path(sys.argv[2])
told = False

def progress(now):
    global told
    if now.sent and not told:
        told = True
        say("stop me")
        sys.stdin.readline()

run_scenario(load_scenario(sys.argv[3], overrides, duration_s=1.0), out, progress)
"""


def state(pid: int) -> str:
    return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]


def stopped(scenario: str, out: Path) -> Result:
    """The result of a run whose process stood still for a while."""
    source, sink = free_domains()[:2]
    overrides = [f"robots.0.graph.domain_id={source}", f"robots.1.graph.domain_id={sink}"]
    with subprocess.Popen(
        [sys.executable, "-c", PROGRAM, json.dumps(overrides), str(out), scenario],
        cwd=ROOT,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdin is not None and process.stdout is not None
        assert process.stdout.readline() == "stop me\n"
        os.kill(process.pid, signal.SIGSTOP)
        wait_for(lambda: state(process.pid) == "T", "a process that stands still")
        since = time.monotonic()
        wait_for(lambda: time.monotonic() - since >= STOPPED_S, "a while")
        os.kill(process.pid, signal.SIGCONT)
        process.stdin.write("\n")
        process.stdin.close()
        assert process.wait() == 0
    return read_result(out)


@pytest.mark.slow
@pytest.mark.real_time
def test_a_process_that_was_stopped_is_named_with_how_long(tmp_path: Path) -> None:
    result = stopped("paper-direct", tmp_path)
    late = result.lateness
    assert late is not None
    assert set(late.worst_s) == {"threads"}
    assert late.worst_s["threads"] >= STOPPED_S - PERIOD_S
    assert late.moments >= 1
    assert 0 < late.share <= 1
    assert late.lost_after <= late.lost <= late.sent >= late.sent_after
    first = explanation(result, read_trace(tmp_path))[0]
    assert first.startswith("The computer did not keep up with the clock: ")


@pytest.mark.slow
@pytest.mark.real_time
def test_robots_with_a_radio_wait_for_a_process_that_was_stopped(tmp_path: Path) -> None:
    result = stopped("paper-ofdm-paced", tmp_path)
    assert result.lateness is None
    assert result.counters["medium"]["slow_s"] >= STOPPED_S - 2 * PERIOD_S
    assert all(topic.delivered == topic.sent for topic in result.topics)
    assert explanation(result, read_trace(tmp_path))[0].startswith("The computer carried 2 robots at ")


def test_a_pulse_measures_from_its_start_to_its_end() -> None:
    pulse = Pulse()
    pulse.start()
    wait_for(lambda: pulse.lateness.worst > 0, "a beat")
    pulse.close()
    pulse.close()
    assert pulse.lateness.worst < 60
    Pulse().close()
