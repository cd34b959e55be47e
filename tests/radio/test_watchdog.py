"""A thread that sends and does not go on is noticed, and systemd hears of a link only while it goes on."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from math import inf
from pathlib import Path

import pytest

from gr_ros2.core.errors import RadioError
from gr_ros2.radio import robot_link
from tests.domains import free_ports
from tests.radio.robots import ROOT, Robot
from tests.waiting import PATIENCE_S, wait_for

MODEM = {"name": "modem", "options": {"bit_rate": 1e6}}


def udp() -> dict[str, object]:
    own, other = free_ports(2)
    return {"name": "udp", "listen": f"127.0.0.1:{own}", "send_to": [f"127.0.0.1:{other}"]}


def test_a_link_that_goes_on_passes(tmp_path: Path) -> None:
    with Robot(1, udp(), phy=MODEM, state=str(tmp_path / "state")) as one:
        wait_for(lambda: one.link.stats()["packets"]["out"] > 2, "some hellos")
        one.link.check()
        assert one.link.source.stalled_s(one.link._clock()) < robot_link.STALLED_S
        assert one.link.radio.gate.stalled_s() < robot_link.STALLED_S


def test_a_sending_thread_that_hangs_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(robot_link, "STALLED_S", 0.2)
    with Robot(1, udp(), phy=MODEM, state=str(tmp_path / "state")) as one:
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


def test_a_link_that_was_frozen_as_a_whole_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with Robot(1, udp(), phy=MODEM, state=str(tmp_path / "state")) as one:
        wait_for(lambda: one.link.stats()["packets"]["out"] > 2, "some hellos")
        one.link.check()
        clock, frozen_s = one.link._clock, robot_link.STALLED_S + 2.0
        # It looks first, before the threads that stood still with it.
        monkeypatch.setattr(one.link, "_clock", lambda: clock() + frozen_s)
        monkeypatch.setattr(one.link.source, "stalled_s", lambda _: frozen_s)
        monkeypatch.setattr(one.link.radio.gate, "stalled_s", lambda: frozen_s)
        one.link.check()
        monkeypatch.undo()
        one.link.check()


def test_a_sending_thread_that_has_ended_is_named(tmp_path: Path) -> None:
    with Robot(1, udp(), phy=MODEM, state=str(tmp_path / "state")) as one:
        one.link.source.stop()
        assert one.link.source.stalled_s(0.0) == 0.0
        one.link.source._running = True
        assert one.link.source.stalled_s(0.0) == inf


@pytest.fixture
def systemd(tmp_path: Path) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as made:
        made.bind(str(tmp_path / "notify"))
        made.settimeout(PATIENCE_S)
        yield made


def service(folder: Path, command: Sequence[str] = ("-m", "gr_ros2.cli")) -> subprocess.Popen[bytes]:
    """A link as systemd starts it."""
    (folder / "robot.yaml").write_text(
        "robot: /robot_1\ntopics: [odom]\ngraph: {middleware: memory}\n"
        f"state: {folder / 'state'}\nphy: {{name: modem}}\nfront_end: {udp()}\n"
    )
    return subprocess.Popen(
        [sys.executable, *command, "link", str(folder / "robot.yaml")],
        env={**os.environ, "NOTIFY_SOCKET": str(folder / "notify"), "XDG_RUNTIME_DIR": str(folder)},
        stdout=subprocess.DEVNULL,
        cwd=ROOT,
    )


def test_systemd_hears_of_a_link_that_runs(tmp_path: Path, systemd: socket.socket) -> None:
    process = service(tmp_path)
    assert [systemd.recv(100) for _ in range(3)] == [b"READY=1", b"WATCHDOG=1", b"WATCHDOG=1"]
    process.send_signal(signal.SIGINT)
    assert process.wait(PATIENCE_S) == 0


HANGS = """
import runpy, threading
from gr_ros2.gr.sending import SendingBlock
from gr_ros2.radio import robot_link
robot_link.STALLED_S = 1.0
SendingBlock._compose = lambda self: threading.Event().wait() and []
runpy.run_module("gr_ros2.cli", run_name="__main__")
"""


def test_systemd_hears_nothing_more_once_the_sending_thread_hangs_but_what_hangs(
    tmp_path: Path, systemd: socket.socket
) -> None:
    process = service(tmp_path, ["-c", HANGS])
    told = [systemd.recv(200)]
    while not told[-1].startswith(b"STATUS="):
        told.append(systemd.recv(200))
    assert told[0] == b"READY=1"
    assert b"the sending thread has not gone on" in told[-1]
    assert process.wait(PATIENCE_S) == 1
    systemd.setblocking(False)
    with pytest.raises(BlockingIOError):
        systemd.recv(200)


def test_the_template_of_systemd_asks_for_both() -> None:
    unit = (ROOT / "debian" / "gr-ros2@.service").read_text().splitlines()
    assert {"Type=notify", "NotifyAccess=main", "WatchdogSec=30", "Restart=on-failure"} <= set(unit)
