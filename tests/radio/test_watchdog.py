"""A thread that sends and does not go on is noticed, and systemd hears of a link only while it goes on."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
from math import inf
from pathlib import Path

import pytest

pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")

from gr_ros2.core.errors import RadioError
from gr_ros2.radio import robot_link
from tests.radio.cables import free_ports
from tests.radio.robots import ROOT, Robot
from tests.waiting import PATIENCE_S, wait_for

MODEM = {"name": "modem", "options": {"bit_rate": 1e6}}


def udp() -> dict[str, object]:
    own, other = free_ports(2, socket.SOCK_DGRAM)
    return {"name": "udp", "listen": f"127.0.0.1:{own}", "send_to": [f"127.0.0.1:{other}"]}


def test_a_link_that_goes_on_passes(tmp_path: Path) -> None:
    with Robot(1, udp(), version=1, phy=MODEM, state=str(tmp_path / "state")) as one:
        wait_for(lambda: one.link.stats()["packets"]["out"] > 2, "some hellos")
        one.link.check()
        assert one.link.source.stalled_s(one.link._clock()) < robot_link.STALLED_S
        assert one.link.radio.gate.stalled_s() < robot_link.STALLED_S


def test_a_sending_thread_that_hangs_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(robot_link, "STALLED_S", 0.2)
    with Robot(1, udp(), version=1, phy=MODEM, state=str(tmp_path / "state")) as one:
        wait_for(lambda: one.link.stats()["packets"]["out"] > 2, "some hellos")

        def hangs() -> bool:
            try:
                one.link.check()
            except RadioError as error:
                return "the sending thread has not gone on" in str(error)
            return False

        hung = threading.Event()
        monkeypatch.setattr(one.link.source, "_compose", lambda: hung.wait() and [])
        wait_for(hangs, "the finding")
        hung.set()


def test_a_sending_thread_that_has_ended_is_named(tmp_path: Path) -> None:
    with Robot(1, udp(), version=1, phy=MODEM, state=str(tmp_path / "state")) as one:
        one.link.source.stop()
        assert one.link.source.stalled_s(0.0) == 0.0
        one.link.source._running = True
        assert one.link.source.stalled_s(0.0) == inf


def test_systemd_hears_of_a_link_that_runs(tmp_path: Path) -> None:
    front_end = udp()
    (tmp_path / "robot.yaml").write_text(
        f"ros_source: {{robot_id: 1, namespace: /robot_1, topics: [odom], middleware: memory}}\n"
        f"ros_sink: {{middleware: memory}}\nstate: {tmp_path / 'state'}\nphy: {{name: modem}}\nfront_end: {front_end}\n"
    )
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(str(tmp_path / "notify"))
        systemd.settimeout(PATIENCE_S)
        process = subprocess.Popen(
            [sys.executable, "-m", "gr_ros2.cli", "link", str(tmp_path / "robot.yaml")],
            env={**os.environ, "NOTIFY_SOCKET": str(tmp_path / "notify"), "XDG_RUNTIME_DIR": str(tmp_path)},
            stdout=subprocess.DEVNULL,
            cwd=ROOT,
        )
        assert [systemd.recv(100) for _ in range(3)] == [b"READY=1", b"WATCHDOG=1", b"WATCHDOG=1"]
        process.send_signal(signal.SIGINT)
        assert process.wait(PATIENCE_S) == 0


def test_the_template_of_systemd_asks_for_both() -> None:
    unit = (ROOT / "debian" / "gr-ros2@.service").read_text().splitlines()
    assert {"Type=notify", "NotifyAccess=main", "WatchdogSec=30", "Restart=on-failure"} <= set(unit)
