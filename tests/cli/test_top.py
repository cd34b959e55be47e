"""`gr-ros2 top`, over links in processes of their own that begin, hang, are killed and end."""

from __future__ import annotations

import json
import os
import pty
import signal
import subprocess
import sys
import termios
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")

from gr_ros2.cli import control_socket, top
from gr_ros2.cli.console import console
from gr_ros2.cli.control_socket import ControlSocket, folder, sockets
from gr_ros2.cli.dashboard import audience
from gr_ros2.cli.top import Links, link_table
from tests.cli.test_status import COMMAND, Ends, ends  # noqa: F401 - a fixture
from tests.programs import ProgramProcess
from tests.waiting import PATIENCE_S, wait_for


def rows(ends: Ends) -> list[dict[str, Any]]:  # noqa: F811
    """What it tells programs."""
    answer = ends.run("top", "--json")
    found: list[dict[str, Any]] = json.loads(answer.stdout) if answer.returncode == 0 else []
    return found


def test_links_that_begin_hang_are_killed_and_end(ends: Ends) -> None:  # noqa: F811
    nobody = ends.run("top")
    assert (nobody.returncode, nobody.stderr) == (
        1,
        "gr-ros2: no link of yours runs; start one with gr-ros2 link\n",
    )
    first = ends.link(1, "--set", "airtime.duty_cycle=0.5")
    wait_for(lambda: len(rows(ends)) == 1, "the first link")
    second = ends.link(2)
    wait_for(lambda: [len(row.get("peers", ())) for row in rows(ends)] == [1, 1], "both")
    one, two = rows(ends)
    assert (one["pid"], one["name"], one["robot"], one["front_end"], one["phy"]) == (
        first.pid,
        "one",
        1,
        "udp",
        "modem",
    )
    assert two["peers"][0]["robot"] == 1
    assert one["sent"] >= 0
    assert 0 <= one["air"] <= 1
    first.send_signal(signal.SIGUSR1)
    wait_for(lambda: "transmitter: sending is off" in rows(ends)[0]["warnings"], "the warning")
    shown = ends.run("top", "--once").stdout
    assert "one: transmitter: sending is off" in shown
    second.send_signal(signal.SIGSTOP)
    wait_for(lambda: [row["answers"] for row in rows(ends)] == [True, False], "one that does not answer")
    assert rows(ends)[-1]["warnings"][0].startswith("has not answered for ")
    second.send_signal(signal.SIGCONT)
    second.send_signal(signal.SIGKILL)
    second.wait(PATIENCE_S)
    wait_for(lambda: [row.get("robot") for row in rows(ends)] == [1], "the one that is left")
    assert [path.stem for path in (ends.folder / f"gr-ros2-{os.getuid()}").iterdir()] == [str(first.pid)]


@contextmanager
def in_a_terminal(ends: Ends) -> Iterator[tuple[subprocess.Popen[bytes], int, list[str]]]:  # noqa: F811
    """It runs there: its process, the terminal, and what is shown."""
    terminal, slave = pty.openpty()
    before = termios.tcgetattr(slave)
    env = {**ends.env, "TERM": "xterm", "COLUMNS": "120", "LINES": "40"}
    process = ProgramProcess([*COMMAND, "top"], env=env, stdin=slave, stdout=slave, stderr=slave)
    shown: list[str] = []

    def read() -> None:
        with suppress(OSError):  # nobody writes any more
            while text := os.read(terminal, 4096):
                shown.append(text.decode(errors="replace"))

    reader = threading.Thread(target=read, daemon=True)
    reader.start()
    try:
        yield process, terminal, shown
        assert process.wait(PATIENCE_S) == 0
        assert termios.tcgetattr(slave) == before
    finally:
        process.kill()
        process.wait()
        os.close(slave)
        reader.join()
        os.close(terminal)


@pytest.mark.parametrize("leave", ["q", "ctrl-c"])
def test_in_a_terminal_it_goes_on_until_it_is_left(ends: Ends, leave: str) -> None:  # noqa: F811
    def says(word: str) -> None:
        wait_for(lambda: word in "".join(shown), word)

    first = ends.link(1)
    wait_for(lambda: rows(ends), "a link")
    with in_a_terminal(ends) as (process, terminal, shown):
        says("one")
        ends.link(2)
        says("two")
        for link in (first, ends.running[1]):
            link.send_signal(signal.SIGINT)
            link.wait(PATIENCE_S)
        shown.clear()
        says("no link of yours runs; start one with gr-ros2 link")
        os.write(terminal, b"x")
        if leave == "q":
            os.write(terminal, b"q")
        else:
            process.send_signal(signal.SIGINT)


def test_a_run_is_no_link_and_an_answer_of_another_release_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    with Links() as links:
        with audience(None, console(), "a run"):
            links.look()
            wait_for(lambda: links.settled, "its refusal")
            assert links.look() == []
        assert links.look() == []
        for told in ({}, {"name": "x"}, 7, None, "\n"):
            with ControlSocket("strange", lambda _, told=told: {"status": told}):
                wait_for(links.look, "its answer")
                (row,) = links.look()
                assert row["warnings"][0].startswith("its answer is not understood (")
                assert "\n" not in row["warnings"][0]
            assert links.look() == []
    wait_for(lambda: not any(one.name.startswith("gr-ros2-top") for one in threading.enumerate()), "its threads to end")


def test_a_table_that_was_frozen_itself_accuses_no_link(monkeypatch: pytest.MonkeyPatch) -> None:
    """It looks first, before the thread that asks, which stood still with it."""
    asked, hangs, frozen_s = [0], threading.Event(), [0.0]

    def ask(*_: object) -> None:
        asked[0] += 1
        if asked[0] > 1:
            hangs.wait()
        raise ValueError

    monkeypatch.setattr(top, "ask_link", ask)
    monkeypatch.setattr(top, "_EVERY_S", 0.01)
    monkeypatch.setattr(top.time, "monotonic", lambda real=top.time.monotonic: real() + frozen_s[0])
    watched = top.Watched(1)
    wait_for(lambda: asked[0] > 1 and watched.row(), "an answer")
    frozen_s[0] = 12.0
    row = watched.row()
    assert row is not None
    assert row["answers"]
    monkeypatch.undo()
    watched.gone.set()
    hangs.set()


def test_words_of_another_program_are_no_markup() -> None:
    row = {"pid": 7, "name": "[red]x[/nothing]\x1b[2J", "answers": True, "warnings": ["[/]"]}
    screen = console()
    with screen.capture() as shown:
        screen.print(link_table([row]))
    assert "[red]x[/nothing]\\x1b[2J: [/]" in shown.get()
    assert "\x1b[2J" not in shown.get()


def test_root_asks_the_programs_of_all_users_and_services(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setattr(control_socket, "_OF_OTHERS", (f"{tmp_path}/run/*/gr-ros2-*/*.sock".lstrip("/"),))
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    theirs = tmp_path / "run" / "robot" / "gr-ros2-61184"
    theirs.mkdir(parents=True)
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as process:
        (theirs / f"{process.pid}.sock").touch()
        (theirs / "4194304.sock").touch()  # no process can have this number
        own = folder() / "1.sock"
        own.touch()
        assert sockets() == {process.pid: theirs / f"{process.pid}.sock", 1: own}
        monkeypatch.setattr(os, "geteuid", lambda: 1000)
        assert sockets() == {1: own}
        process.communicate(b"\n")
