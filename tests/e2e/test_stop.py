"""Ctrl-C on a real run: it ends cleanly and its result is written."""

from __future__ import annotations

import os
import pty
import re
import signal
import subprocess
import threading
from pathlib import Path

import pytest

from gr_ros2_lab.record.result import read_result
from tests.e2e.support import COMMAND, check_books, delivered_bag, on_free_domains, set_options
from tests.programs import ProgramProcess
from tests.waiting import PATIENCE_S, wait_for


class Run:
    """`gr-ros2 run` on a terminal of its own."""

    def __init__(self, *arguments: str) -> None:
        self._terminal, end = pty.openpty()
        self.process = ProgramProcess(
            [*COMMAND, "run", *arguments],
            stdout=end,
            stderr=subprocess.PIPE,
            stdin=subprocess.DEVNULL,
            text=True,
            env={**os.environ, "TERM": "xterm"},  # a `dumb` one shows no progress
        )
        os.close(end)
        self.shown = ""
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        while True:
            try:
                data = os.read(self._terminal, 4096)
            except OSError:  # Linux's way to say that the other end is closed
                return
            if not data:
                return
            self.shown += data.decode("utf-8", "replace")

    @property
    def delivered(self) -> int:
        """The newest number of delivered messages the progress line has shown."""
        return max((int(number) for number in re.findall(r"(\d+) delivered", self.shown)), default=0)

    def end(self) -> str:
        """Wait for the end; what it said on stderr."""
        _, errors = self.process.communicate(timeout=PATIENCE_S)
        self._reader.join(PATIENCE_S)
        os.close(self._terminal)
        return errors


@pytest.mark.slow
@pytest.mark.parametrize(("name", "number"), [("paper-direct", signal.SIGINT), ("paper-ofdm", signal.SIGTERM)])
def test_a_run_that_is_stopped_writes_its_result(tmp_path: Path, name: str, number: signal.Signals) -> None:
    out = tmp_path / "out"
    run = Run(name, "--duration", "600", "--out", str(out), *set_options(on_free_domains()))
    try:
        wait_for(lambda: run.delivered >= 10 or run.process.poll() is not None, "messages to be delivered")
        run.process.send_signal(number)
        errors = run.end()
    finally:
        run.process.kill()
    assert errors == ""
    assert run.process.returncode == 0, run.shown
    assert "stopped after" in run.shown
    result = read_result(out)
    check_books(result)
    assert result.interrupted
    assert 0 < result.duration_s < 600
    assert result.topics[0].delivered >= 10
    assert len(delivered_bag(out, "/rx_robot_1/odom")) == result.topics[0].delivered
