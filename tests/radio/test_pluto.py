"""The `pluto` front end with GNU Radio's and libiio's own code, against a server that speaks as a Pluto does.

In processes of their own, which GNU Radio's blocks end when the server is gone.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("gnuradio.iio", reason="needs gr-iio")

from gr_ros2.core.errors import RadioError
from gr_ros2.radio.pluto import _stderr_deferred
from gr_ros2.radio.robot_link import RobotLink
from tests.radio.pluto import PHY, RX, Pluto
from tests.radio.robots import ROOT, config, link_command

SLOW = 6e5
"""samples/s; near the slowest a Pluto has."""
MESSAGES = 10
TALK = """
import json, sys
from tests.waiting import wait_for
from gr_ros2.radio.pluto import PlutoFrontEnd
from tests.radio.robots import Robot

PlutoFrontEnd.loops_back = True
front_end, phy = map(json.loads, sys.argv[1:])
with Robot(1, front_end, hears=(1,), repair="off", phy=phy) as robot:
    said = robot.say(*range(10))
    wait_for(lambda: robot.silent and len(robot.heard) >= len(said), "every message")
    print(json.dumps({"heard": robot.heard == said, "out": robot.link.stats()["packets"]["out"],
                      "layout": robot.link.front_end.layout.total}))
"""
NOBODY = "ip:127.0.0.1:1"
"""A port at which nothing listens."""


@pytest.fixture
def pluto() -> Iterator[Pluto]:
    with Pluto(frequency=(325e6, 3.8e9), hardwaregain=(-89.75, 71)) as device:
        yield device


def link(path: Path, *options: str, **front_end: Any) -> subprocess.CompletedProcess[str]:
    """``gr-ros2 link`` on a Pluto."""
    return link_command(path, {"name": "pluto", "frequency": 433e6, **front_end}, SLOW, *options)


@pytest.mark.slow
def test_every_packet_is_one_buffer_and_comes_back(pluto: Pluto) -> None:
    front_end = {
        "name": "pluto",
        "args": pluto.uri,
        "frequency": 433e6,
        "frequency_rx": 434e6,
        "gain_tx": -20,
        "gain_rx": 40,
        "bandwidth": 5e5,
    }
    command = [sys.executable, "-c", TALK, json.dumps(front_end), json.dumps({"name": "psk", "sample_rate": SLOW})]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=False)
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout.splitlines()[-1])
    assert result["heard"]
    assert pluto.bursts == [result["layout"]] * result["out"]
    settings = pluto.settings
    assert settings[PHY, "OUTPUT", "altvoltage1", "frequency"] == "433000000"
    assert settings[PHY, "OUTPUT", "altvoltage0", "frequency"] == "434000000"
    assert settings[PHY, "OUTPUT", "voltage0", "hardwaregain"] == "-20.000000 dB"
    assert settings[PHY, "INPUT", "voltage0", "hardwaregain"] == "40.000000 dB"
    assert settings[PHY, "INPUT", "voltage0", "gain_control_mode"] == "manual"
    assert settings[PHY, "OUTPUT", "voltage0", "rf_bandwidth"] == "500000"
    assert settings[RX, "INPUT", "voltage0", "sampling_frequency"] == f"{SLOW:.0f}"


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            {"frequency": 1e8},
            "the device is tuned to 2,450,000,000 Hz, not to 100,000,000; set frequency to one it has",
        ),
        (
            {"frequency_rx": 6e9},
            "the device is tuned to 2,400,000,000 Hz, not to 6,000,000,000; set frequency_rx to one it has",
        ),
        ({"gain_rx": 75}, "the device has a gain of 71 dB, not of 75; set gain_rx to one it has"),
    ],
)
def test_what_a_pluto_does_not_take_is_said_in_a_line(
    pluto: Pluto, tmp_path: Path, change: dict[str, Any], said: str
) -> None:
    # GNU Radio's blocks log a warning and go on.
    done = link(tmp_path / "robot.yaml", args=pluto.uri, **change)
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert f"front_end pluto: args = {pluto.uri!r}: {said}" in line
    assert not pluto.bursts


def test_another_sample_rate_is_refused(pluto: Pluto, tmp_path: Path) -> None:
    fixed = pluto.write
    pluto.write = lambda key, value: fixed(key, "700000" if key[-1] == "sampling_frequency" else value)  # type: ignore[method-assign]
    done = link(tmp_path / "robot.yaml", args=pluto.uri)
    assert done.returncode == 1
    assert "the device runs at 700,000 samples/s, not at 600,000; set phy.sample_rate" in done.stderr


@pytest.mark.slow
def test_a_link_that_ends_at_once_ends(pluto: Pluto, tmp_path: Path) -> None:
    done = link(tmp_path / "robot.yaml", "--duration", "0.1", args=pluto.uri)
    assert done.returncode == 0, done.stderr


def test_a_pluto_that_is_not_there_is_one_line(tmp_path: Path) -> None:
    done = link(tmp_path / "robot.yaml", args=NOBODY)
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert f"front_end pluto: args = {NOBODY!r}: " in line


def test_what_libiio_writes_is_kept(caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str]) -> None:
    with caplog.at_level("DEBUG", "gr_ros2"), pytest.raises(RadioError, match="iio_info -S"):
        RobotLink(config(1, {"name": "pluto", "args": NOBODY, "frequency": 433e6}))
    assert "front_end pluto: while it was opened: " in caplog.text
    assert capfd.readouterr().err == ""
    # What came of an opening that went well is not lost.
    with _stderr_deferred():
        os.write(2, b"of another thread\n")
        assert capfd.readouterr().err == ""
    assert capfd.readouterr().err == "of another thread\n"
