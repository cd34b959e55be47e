"""The one line that says how a live link is doing."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from gr_ros2.cli.ending import BAD_INPUT
from gr_ros2.cli.link import status_line
from gr_ros2.cli.main import run
from gr_ros2.middleware import Qos
from gr_ros2.middleware.dds import DdsMiddleware
from gr_ros2.radio.config import load_link
from tests.domains import free_domains
from tests.programs import ProgramProcess
from tests.waiting import PATIENCE_S, wait_for

BETWEEN_S = 0.25
"""s from one message to the next, until one has come across."""
ROOT = Path(__file__).resolve().parents[2]


def stats(
    snr_db: float | None, missing: int = 0, damaged: int = 0, unpublished: int = 0, lost: int = 0
) -> dict[str, Any]:
    return {
        "uptime_s": 12.4,
        "source": {
            "unmatched": [],
            "topics": {
                "/odom": {"submitted": 7, "lost_on_graph": lost, "types": 1},
                "/scan": {"submitted": 1, "lost_on_graph": 0, "types": 1},
            },
        },
        "sink": {
            "topics": {"/rx_robot_2/odom": {"delivered": 5}},
            "packets": 60,
            "packet_loss_est": missing,
            "publish_failed": unpublished,
        },
        "packets": {"out": 90, "in": 64, "refused": 0, "damaged": damaged},
        "peers": [],
        "phy": {"snr_db": snr_db},
        "front_end": {"name": "uhd", "passed": {"bursts_out": 90}, "lost": {"overflows": 0}},
        "airtime": {"transmits": True, "sent_s": 0.0, "refused": {}},
    }


def test_a_link_that_sends_nothing_says_what_it_waits_for() -> None:
    silent = stats(None)
    silent["source"]["topics"] = {"/odom": {"submitted": 0, "lost_on_graph": 0, "types": 1}}
    silent["source"]["unmatched"] = ["/odom", "/scan"]
    silent["packets"] |= {"out": 0, "in": 3}  # of another link
    silent["sink"]["packets"] = 0
    assert status_line(silent) == "12 s; nothing sent, no publisher on /odom and 1 more; nobody heard"
    silent["source"]["unmatched"] = []
    assert status_line(silent).startswith("12 s; sent 0 messages in 0 packets")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ((), "give a YAML file, or --robot and --radio"),
        (("--robot", "1"), "give a YAML file, or --robot and --radio"),
        (("mine.yaml", "--robot", "0"), "--robot: mine.yaml says what the link is; change its settings with --set"),
        (("mine.yaml", "--listen", "1", "--peer", "2"), "--listen, --peer: mine.yaml says"),
        (("--robot", "255", "--radio", "sim"), "--robot"),
        (("--robot", "1", "--radio", "nope"), "no 'nope'; known are sim, zmq"),
        (
            ("--robot", "1", "--radio", "sim", "--middleware", "nope"),
            "graph.middleware = 'nope': no such",
        ),
    ],
)
def test_half_a_line_is_refused(arguments: tuple[str, ...], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["link", *arguments]) == BAD_INPUT
    assert said in capsys.readouterr().err


def test_the_middleware_is_that_of_both_directions(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")
    saved = tmp_path / "link.yaml"
    line = ("link", "--robot", "1", "--radio", "sim", "--middleware", "memory", "--save", str(saved))
    assert run([*line, "--duration", "0.1"]) == 0
    assert run(["link", str(saved), "--middleware", "nope"]) == BAD_INPUT
    assert "nope" in capsys.readouterr().err
    settings = load_link(saved)
    assert settings.graph.middleware == "memory"


def test_those_who_look_on_know_the_link_before_it_hears_anything(monkeypatch: pytest.MonkeyPatch) -> None:
    """They pass over what comes before they know it: topics of a robot that has told them would never be shown."""
    pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")
    from gr_ros2.observe.observers import RunObservers
    from gr_ros2.radio.robot_link import RobotLink

    known: list[bool] = []
    started, began = RunObservers.run_started, RobotLink.start

    def run_started(self: RunObservers, live: Any) -> None:
        known.append(True)
        started(self, live)

    def start(self: RobotLink) -> None:
        assert known
        began(self)

    monkeypatch.setattr(RunObservers, "run_started", run_started)
    monkeypatch.setattr(RobotLink, "start", start)
    line = ("link", "--robot", "1", "--radio", "sim", "--middleware", "memory")
    assert run([*line, "--duration", "0.1"]) == 0


@pytest.mark.slow
def test_two_robots_in_one_line_each(tmp_path: Path) -> None:
    """No file: a message crosses, each says what it waits for, and what is saved starts the same link again."""
    pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")
    pytest.importorskip("zmq", reason="needs pyzmq")
    domains = free_domains()
    addresses = [f"ipc://{tmp_path}/{number}" for number in (1, 2)]
    registry = tmp_path / "topics.csv"
    registry.write_text("cmd_vel,geometry_msgs/Twist\n")
    running: list[tuple[subprocess.Popen[str], Path]] = []

    def start(robot: int, *options: str) -> Path:
        log = tmp_path / f"{robot}-{len(running)}.log"
        command = [sys.executable, "-m", "gr_ros2.cli", "link", *options]
        environ = {**os.environ, "ROS_DOMAIN_ID": str(domains[robot - 1]), "PYTHONPATH": str(ROOT)}
        with log.open("w") as file:
            running.append((ProgramProcess(command, env=environ, stdout=file, stderr=file, text=True), log))
        return log

    def line(robot: int) -> tuple[str, ...]:
        own, other = addresses[robot - 1], addresses[2 - robot]
        return "--robot", str(robot), "--radio", "zmq", "--listen", own, "--peer", other, "--registry", str(registry)

    try:
        saved = tmp_path / "robot2.yaml"
        first = start(1, *line(1))
        start(2, *line(2), "--save", str(saved))
        wait_for(lambda: "no publisher on /robot_1/cmd_vel" in first.read_text(), "what robot 1 waits for")
        assert "front_end:" in first.read_text()
        heard: list[bytes] = []
        with DdsMiddleware(domain_id=domains[0]) as one, DdsMiddleware(domain_id=domains[1]) as two:
            publisher = one.advertise("/robot_1/cmd_vel", "geometry_msgs/Twist", Qos(depth=10))
            two.subscribe("/rx_robot_1/cmd_vel", "geometry_msgs/Twist", Qos(depth=10), heard.append)
            said = b"\0\1\0\0" + bytes(48)

            published = [0.0]

            def crossed() -> bool:
                if time.monotonic() - published[-1] > BETWEEN_S:  # a busy machine is to keep up with it
                    publisher.publish(said)
                    published.append(time.monotonic())
                return bool(heard)

            wait_for(crossed, "a message on the other side")
            assert heard[0] == said
            process, _ = running[1]
            process.send_signal(signal.SIGINT)
            assert process.wait(PATIENCE_S) == 0
            heard.clear()
            start(2, str(saved))
            wait_for(crossed, "a message, from the saved file")
    finally:
        for process, _ in running:
            process.send_signal(signal.SIGINT)
        for process, _ in running:
            process.wait(PATIENCE_S)


def test_what_passes_is_told_always_and_the_rest_where_there_is_any() -> None:
    quiet = "12 s; sent 8 messages in 90 packets; received 5 messages in 60 packets"
    assert status_line(stats(None)) == quiet
    assert status_line(stats(17.26, missing=3, damaged=2)) == (
        quiet + "; packets lost: about 3; SNR 17.3 dB; 2 damaged"
    )
    assert status_line(stats(None, lost=6, unpublished=4)) == (
        quiet + "; 6 messages lost on the ROS graph before they were sent; 4 messages not published"
    )
