"""`gr-ros2 status`, `peers`, `ping` and `link --check`, against links in processes of their own."""

from __future__ import annotations

import json
import os
import pty
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import redirect_stderr, redirect_stdout, suppress
from io import StringIO
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest

pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")

from gr_ros2.cli import main as command_line
from tests.domains import free_ports
from tests.programs import ProgramProcess, run_program
from tests.waiting import PATIENCE_S, wait_for

COMMAND = [sys.executable, "-m", "gr_ros2.cli"]


class Ends:
    """Two ends of a link over UDP, on graphs in memory."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.env = {**os.environ, "XDG_RUNTIME_DIR": str(folder), "XDG_STATE_HOME": str(folder / "state")}
        ports = free_ports(2)
        self.files = [folder / "one.yaml", folder / "two.yaml"]
        for number, (file, own, other) in enumerate(zip(self.files, ports, reversed(ports), strict=True), 1):
            file.write_text(
                f"robot: /robot_{number}\ntopics: [odom]\ngraph: {{middleware: memory}}\n"
                "phy: {name: modem, options: {bit_rate: 1000000}}\n"
                f"front_end: {{name: udp, listen: '127.0.0.1:{own}', send_to: ['127.0.0.1:{other}']}}\n"
            )
        self.running: list[subprocess.Popen[str]] = []

    def link(self, number: int, *options: str, terminal: int | None = None) -> subprocess.Popen[str]:
        with (self.folder / f"log-{number}").open("w") as log:
            process = ProgramProcess(
                [*COMMAND, "link", str(self.files[number - 1]), *options],
                env={**self.env, "TERM": "xterm", "COLUMNS": "120", "LINES": "40"},
                stdout=log if terminal is None else terminal,
                stderr=log,
                text=True,
            )
        self.running.append(process)
        return process

    def run(self, *words: str) -> subprocess.CompletedProcess[str]:
        """What a command says and how it ends; in this process, but for another link."""
        if words[0] == "link":
            return run_program([*COMMAND, *words], env=self.env, capture_output=True, text=True, check=False)
        with patch.dict(os.environ, self.env), redirect_stdout(StringIO()) as out, redirect_stderr(StringIO()) as err:
            status = command_line.run(words)
        return subprocess.CompletedProcess(words, status, out.getvalue(), err.getvalue())

    def heard(self) -> bool:
        answer = self.run("peers", "--json", "--pid", str(self.running[0].pid))
        return answer.returncode == 0 and bool(json.loads(answer.stdout))


@pytest.fixture
def ends(tmp_path: Path) -> Iterator[Ends]:
    made = Ends(tmp_path)
    yield made
    for process in made.running:
        process.send_signal(signal.SIGINT)
        process.wait(PATIENCE_S)


@pytest.mark.slow
def test_in_a_terminal_a_link_shows_a_table_and_plain_lines_elsewhere(ends: Ends) -> None:
    terminal, slave = pty.openpty()
    shown: list[str] = []

    def read() -> None:
        with suppress(OSError):  # the link has ended
            while text := os.read(terminal, 4096):
                shown.append(text.decode(errors="replace"))

    def says(*words: str) -> None:
        wait_for(lambda: all(word in "".join(shown) for word in words), " and ".join(words))

    reader = threading.Thread(target=read, daemon=True)
    reader.start()
    first = ends.link(1, "--set", "airtime.duty_cycle=0.5", terminal=slave)
    os.close(slave)
    ends.link(2)
    says("heard ago", "packets lost", "packets sent", "sent 0", "of 1.8e+03 s allowed in 3600 s")
    shown.clear()
    first.send_signal(signal.SIGUSR1)
    says("sending is off")
    first.send_signal(signal.SIGINT)
    assert first.wait(PATIENCE_S) == 0
    reader.join()
    os.close(terminal)
    log = ends.folder / "log-2"
    wait_for(lambda: "10 s; " in log.read_text(), "a plain line")
    assert "\x1b" not in log.read_text()


def test_a_running_link_tells_what_it_does(ends: Ends) -> None:
    first = ends.link(1)
    second = ends.link(2)
    wait_for(ends.heard, "the other end")
    pid = str(first.pid)
    (peer,) = json.loads(ends.run("peers", "--json", "--pid", pid).stdout)
    assert (peer["robot"], peer["silent"]) == (2, False)
    status: dict[str, Any] = json.loads(ends.run("status", "--json", "--pid", pid).stdout)
    assert status["packets"]["out"] > 0
    shown = ends.run("status", "--pid", pid).stdout
    assert "robot 1" in shown
    assert "packets sent" in shown
    several = ends.run("status")
    assert (several.returncode, "say which with --pid" in several.stderr) == (2, True)
    changed = ends.run("set", "topics.odom.to=2", "debug=true", "--pid", pid)
    odom, debug = changed.stdout.splitlines()
    assert odom == "topics.odom.to = 2; no topic odom is sent now, it waits for one; nothing is sent yet"
    assert debug == "debug = True"
    fixed = ends.run("set", "packet_len=64", "--pid", pid)
    assert (fixed.returncode, len(fixed.stderr.splitlines())) == (1, 1)
    assert "packet_len cannot change while the link runs; these can: " in fixed.stderr
    told = json.loads(ends.run("ping", "2", "--json", "--count", "5", "--interval", "0.2", "--pid", pid).stdout)
    assert (told["asked"], told["lost_there"], told["about"]["packet_len"]) == (5, 0, 220)
    assert told["answered"] >= 4
    assert told["round_trip_s"]["p50"] <= told["round_trip_s"]["p99"]
    second.send_signal(signal.SIGINT)
    second.wait(PATIENCE_S)
    gone = ends.run("ping", "2", "--json", "--count", "2", "--interval", "0.2", "--pid", pid)
    assert (gone.returncode, json.loads(gone.stdout)["answered"]) == (1, 0), (
        "the answers of the ping before do not count"
    )


def test_two_ends_that_match_and_two_that_do_not(ends: Ends) -> None:
    ends.link(2)
    same = ends.run("link", str(ends.files[0]), "--check")
    assert (same.returncode, same.stderr) == (0, "")
    assert "both ends match" in same.stdout
    alone = ends.run("ping", "2", str(ends.files[0]), "--json", "--count", "3", "--interval", "0.3")
    assert json.loads(alone.stdout)["answered"] >= 1
    other = ends.run("link", str(ends.files[0]), "--check", "--set", "packet_len=100")
    assert other.returncode == 1
    assert "does not match: packet_len is 220 there and 100 here" in other.stdout


def test_nobody_there(ends: Ends) -> None:
    lone = ends.run("link", str(ends.files[0]), "--check", "--duration", "1")
    assert lone.returncode == 1
    assert "nothing: no signal and no bytes" in lone.stdout
    other = ends.run(
        "link",
        str(ends.files[0]),
        "--check",
        "--duration",
        "1",
        "--against",
        str(ends.files[1]),
        "--set",
        "packet_len=99",
    )
    assert f"{ends.files[1]} does not match: packet_len is 220 there and 99 here" in other.stdout
    assert "start one with gr-ros2 link" in ends.run("status").stderr
    refused = ends.run("ping", "2", str(ends.files[0]), "--set", "paper={}")
    assert (refused.returncode, len(refused.stderr.splitlines())) == (2, 1)
