"""`gr-ros2 topics` and `gr-ros2 want`, among three links in processes of their own, of which one is killed."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack, redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest

pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")

from gr_ros2.cli import main as command_line
from gr_ros2.middleware import Qos
from gr_ros2.middleware.dds import DdsMiddleware
from tests.domains import free_domains, free_ports
from tests.middleware.support import CUSTOM
from tests.programs import ProgramProcess
from tests.waiting import PATIENCE_S, wait_for

COMMAND = [sys.executable, "-m", "gr_ros2.cli"]
QOS = Qos("reliable", "volatile", 0)


class Fleet:
    """Three robots on graphs of their own, of which robot 2 offers ``scan`` and ``map``; robot 4 has no key."""

    def __init__(self, folder: Path) -> None:
        self.env = {**os.environ, "XDG_RUNTIME_DIR": str(folder), "XDG_STATE_HOME": str(folder / "state")}
        self._folder = folder
        self._domains = dict(zip((1, 2, 3, 4), free_domains(4), strict=True))
        self._ports = dict(zip((1, 2, 3, 4), free_ports(4), strict=True))
        key = folder / "fleet.key"
        self._run("key", "new", str(key))
        for number, port in self._ports.items():
            others = [f"'127.0.0.1:{other}'" for other in self._ports.values() if other != port]
            (folder / f"{number}.yaml").write_text(
                f"robot: /robot_{number}\ntopics: [odom]\n"
                f"graph: {{domain_id: {self._domains[number]}, localhost_only: true}}\n"
                "phy: {name: modem, options: {bit_rate: 200000}}\n"
                f"front_end: {{name: udp, listen: '127.0.0.1:{port}', send_to: [{', '.join(others)}]}}\n"
                + (f"key: {key}\n" if number != 4 else "")
                + ("offer: [scan, map]\n" if number == 2 else "")
            )
        self.processes: dict[int, subprocess.Popen[str]] = {}

    def start(self, number: int) -> None:
        with (self._folder / f"log-{number}").open("a") as log:
            self.processes[number] = ProgramProcess(
                [*COMMAND, "link", str(self._folder / f"{number}.yaml")],
                env=self.env,
                stdout=log,
                stderr=log,
                text=True,
            )

    def graph(self, number: int) -> DdsMiddleware:
        return DdsMiddleware(domain_id=self._domains[number], localhost_only=True)

    def ask(self, number: int, *words: str) -> subprocess.CompletedProcess[str]:
        """Run a command that asks the link of a robot."""
        return self._run(*words, "--pid", str(self.processes[number].pid))

    def status(self, number: int) -> dict[str, Any]:
        answer = self.ask(number, "status", "--json")
        found: dict[str, Any] = json.loads(answer.stdout) if not answer.returncode else {}
        return found

    def hears(self, number: int) -> set[int]:
        return {peer["robot"] for peer in self.status(number).get("peers", ()) if not peer["silent"]}

    def wanted(self) -> dict[int, float]:
        """Who wants ``scan`` of robot 2, and how often."""
        held = self.status(2)["wishes"]["wanted"]
        return {wish["robot"]: wish["rate"] for wish in held if wish["topic"] == "scan"}

    def _run(self, *words: str) -> subprocess.CompletedProcess[str]:
        with patch.dict(os.environ, self.env), redirect_stdout(StringIO()) as out, redirect_stderr(StringIO()) as err:
            status = command_line.run(words)
        return subprocess.CompletedProcess(words, status, out.getvalue(), err.getvalue())


@pytest.fixture
def fleet(tmp_path: Path) -> Iterator[Fleet]:
    made = Fleet(tmp_path)
    yield made
    for process in made.processes.values():
        process.send_signal(signal.SIGINT)
        process.wait(PATIENCE_S)


@pytest.mark.slow
def test_three_links_ask_and_one_is_killed(fleet: Fleet) -> None:
    heard: dict[int, list[bytes]] = {1: [], 3: []}
    ended = threading.Event()
    with ExitStack() as stack:
        for number, messages in heard.items():
            graph = stack.enter_context(fleet.graph(number))
            graph.subscribe("/rx_robot_2/scan", CUSTOM, QOS, messages.append)
        scan = stack.enter_context(fleet.graph(2)).advertise("/robot_2/scan", CUSTOM, QOS)

        def talk() -> None:
            while not ended.wait(0.02):
                scan.publish(b"\0\1\0\0" + random.randbytes(60))

        talker = threading.Thread(target=talk, daemon=True)
        talker.start()
        stack.callback(talker.join)
        stack.callback(ended.set)
        for number in (1, 2, 3, 4):
            fleet.start(number)
        wait_for(lambda: fleet.hears(1) >= {2, 3} and fleet.hears(3) >= {1, 2}, "all robots to be heard")

        def rows() -> list[dict[str, Any]]:
            answer = fleet.ask(1, "topics", "2", "--json")
            assert not answer.returncode, answer.stderr
            found: list[dict[str, Any]] = json.loads(answer.stdout)
            return found

        wait_for(rows, "an offer")
        (row,) = rows()
        assert (row["name"], row["type_name"], row["wanted"]) == ("scan", CUSTOM, False)
        assert row["rate"] > 0 and row["size"] > 60
        assert "scan" in fleet.ask(1, "topics", "2").stdout
        assert "robot 3 offers nothing" in fleet.ask(1, "topics", "3").stdout
        assert not heard[1] + heard[3]

        for number, rate in ((1, "4"), (3, "9")):
            answer = fleet.ask(number, "want", "2", "scan", "--rate", rate, "--for", "10min")
            assert answer.returncode == 0, answer.stderr + answer.stdout
            assert answer.stdout.startswith(f"robot 2 sends scan at {rate}/s at most, for ")
        assert fleet.wanted() == {1: 4.0, 3: 9.0}
        wait_for(lambda: heard[1] and heard[3], "messages at both")
        assert "robot 3 wants scan at 9/s at most" in fleet.ask(2, "status").stdout
        assert "robot 2 sends scan at 4/s at most" in fleet.ask(1, "status").stdout

        fleet.processes[3].kill()
        fleet.processes[3].wait(PATIENCE_S)
        fleet.start(3)
        wait_for(lambda: fleet.wanted() == {1: 4.0}, "the wish of the robot that was killed to end")
        heard[1].clear()
        wait_for(lambda: len(heard[1]) > 2, "messages for the other")
        answer = fleet.ask(1, "want", "2", "scan", "--give-up")
        assert (answer.returncode, answer.stdout) == (0, "scan of robot 2 is given up\n")
        wait_for(lambda: "/robot_2/scan" not in fleet.status(2)["source"]["topics"], "it to end")

        refused = fleet.ask(1, "want", "2", "secret")
        assert refused.returncode == 1
        assert refused.stdout == "robot 2 does not offer secret; what it offers: gr-ros2 topics 2\n"
        stranger = fleet.ask(4, "want", "2", "scan")
        assert stranger.returncode == 1
        assert "robot 2 is not heard" in stranger.stderr
        assert fleet.wanted() == {}


@pytest.mark.parametrize("words", [("--for", "soon"), ("--for", "-1"), ("--rate", "-1")])
def test_what_is_no_wish_is_bad_input(words: tuple[str, ...], capsys: pytest.CaptureFixture[str]) -> None:
    assert command_line.run(["want", "2", "scan", *words]) == 2
    assert capsys.readouterr().err.startswith("gr-ros2: ")
