"""Programs that can be looked at are found, answer, and are forgotten when they have gone."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from gr_ros2.cli.doorbell import Doorbell, folder, neighbours, ring
from gr_ros2.errors import ConfigError, RunError
from tests.waiting import wait_for


@pytest.fixture(autouse=True)
def own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))


def test_nobody() -> None:
    assert neighbours() == {}
    with pytest.raises(RunError, match="process 1: does not answer"):
        ring(1, {"x": 1})
    assert folder().stat().st_mode & 0o777 == 0o700


def test_a_program_answers_and_is_gone_afterwards() -> None:
    heard: list[Mapping[str, Any]] = []

    def answer(asked: Mapping[str, Any]) -> Mapping[str, Any]:
        heard.append(asked)
        if "port" not in asked:
            raise ConfigError("no port")
        return {"url": f"http://x:{asked['port']}/"}

    with Doorbell("demo", answer):
        assert neighbours() == {os.getpid(): "demo"}
        assert heard == []
        assert ring(os.getpid(), {"port": 3})["url"] == "http://x:3/"
        with pytest.raises(RunError, match="no port"):
            ring(os.getpid(), {"else": 1})
    assert neighbours() == {}
    assert not [thread for thread in threading.enumerate() if thread.name == "gr-ros2-doorbell"]


def test_one_that_was_killed_is_cleared_away() -> None:
    program = (
        "import time\nfrom gr_ros2.cli.doorbell import Doorbell\nwith Doorbell('victim', lambda asked: {}):\n"
        "    print('ready', flush=True)\n    time.sleep(600)\n"
    )
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True) as victim:
        assert victim.stdout is not None
        assert victim.stdout.readline() == "ready\n"
        assert neighbours() == {victim.pid: "victim"}
        victim.send_signal(signal.SIGKILL)
        victim.wait()
    wait_for(lambda: neighbours() == {}, "the dead one to be forgotten")
    assert list(folder().iterdir()) == []
