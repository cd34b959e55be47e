"""The airtime gate of a flowgraph without a radio block keeps a hard limit, over restarts too."""

from __future__ import annotations

import gc
import time
from pathlib import Path
from typing import Any

import pytest

from gr_ros2.core.errors import ConfigError
from gr_ros2.phy.flowgraph import Flowgraph
from gr_ros2.radio.limits import make_gate
from tests.gr.probe import Probe
from tests.waiting import wait_for

AIRTIME = 0.02


def limited(folder: Path, window_s: float) -> dict[str, Any]:
    """A tenth of each window: five packets of a second."""
    limit = {"duty_cycle": 0.1, "window_s": window_s}
    return {"airtime_limit": limit, "robot_id": 1, "state": str(folder / "robot.json")}


def test_no_second_has_more_packets_than_the_limit_lets_through(tmp_path: Path) -> None:
    top, gate, probe = Flowgraph("test", "test"), make_gate(AIRTIME, **limited(tmp_path, 1)), Probe()
    top.msg_connect((probe, "pdus"), (gate, "pdus"))
    top.msg_connect((gate, "pdus"), (probe, "pdus"))
    top.msg_connect((gate, "credit"), (probe, "credit"))
    begin = time.monotonic()
    with top:
        for number in range(11):
            wait_for(lambda number=number: probe.credits > number, "a credit")
            probe.post(bytes(9))
        wait_for(lambda: probe.handled == 11, "every packet")
        assert probe.times[5] - begin > 1
        assert probe.times[10] - begin > 2
        probe.post(bytes(9))  # without a credit
        wait_for(lambda: gate.account()["refused"] == {"airtime_limit": 1}, "the refusal")


def test_its_account_survives_a_restart_and_has_one_user(tmp_path: Path) -> None:
    gate = make_gate(AIRTIME, **limited(tmp_path, 1000))
    limit = gate._clock.limit
    assert limit is not None
    assert limit.reserve(time.monotonic(), AIRTIME)
    with pytest.raises(ConfigError, match="another link of this robot uses it"):
        make_gate(AIRTIME, **limited(tmp_path, 1000))
    del gate, limit
    gc.collect()
    assert make_gate(AIRTIME, **limited(tmp_path, 1000)).account()["spent_s"] >= AIRTIME


@pytest.mark.parametrize(
    ("airtime", "limit", "said"),
    [
        (AIRTIME, "eu868", "whose account is it"),
        (0.0, "eu868", "nothing to count"),
        (AIRTIME, "amateur", "a station says its callsign in clear"),
        (AIRTIME, {"listen_before_send": True}, "a gate hears nothing"),
        (50.0, {"duty_cycle": 0.01}, "the longest packet takes 50 s, and 36 s are allowed"),
    ],
)
def test_what_it_cannot_keep_is_refused(tmp_path: Path, airtime: float, limit: Any, said: str) -> None:
    robot = {} if "whose" in said else {"robot_id": 1}
    with pytest.raises(ConfigError, match=said):
        make_gate(airtime, airtime_limit=limit, state=str(tmp_path / "robot.json"), **robot)


def test_without_a_limit_it_needs_no_robot() -> None:
    assert "allowed_s" not in make_gate(0.0).account()
