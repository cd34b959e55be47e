"""Programs that can be looked at are found, answer, and are forgotten when they have gone."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Mapping
from contextlib import ExitStack, suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from gr_ros2.cli import control_socket
from gr_ros2.cli.control_socket import ControlSocket, folder, request, running_programs
from gr_ros2.core.errors import ConfigError, RunError
from tests.waiting import PATIENCE_S, wait_for


@pytest.fixture(autouse=True)
def own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))


def test_nobody() -> None:
    assert running_programs() == {}
    with pytest.raises(RunError, match="process 1: does not answer"):
        request(1, {"x": 1})
    assert folder().stat().st_mode & 0o777 == 0o700


def test_a_program_answers_and_is_gone_afterwards() -> None:
    heard: list[Mapping[str, Any]] = []

    def answer(asked: Mapping[str, Any]) -> Mapping[str, Any]:
        heard.append(asked)
        if "port" not in asked:
            raise ConfigError("no port")
        return {"url": f"http://x:{asked['port']}/"}

    with ControlSocket("demo", answer):
        assert running_programs() == {os.getpid(): "demo"}
        assert heard == []
        assert request(os.getpid(), {"port": 3})["url"] == "http://x:3/"
        with pytest.raises(RunError, match="no port"):
            request(os.getpid(), {"else": 1})
    assert running_programs() == {}
    assert not [thread for thread in threading.enumerate() if thread.name == "gr-ros2-control"]


def test_one_that_was_killed_is_cleared_away() -> None:
    program = (
        "import time\nfrom gr_ros2.cli.control_socket import ControlSocket\n"
        "with ControlSocket('victim', lambda asked: {}):\n"
        "    print('ready', flush=True)\n    time.sleep(600)\n"
    )
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True) as victim:
        assert victim.stdout is not None
        assert victim.stdout.readline() == "ready\n"
        assert running_programs() == {victim.pid: "victim"}
        victim.send_signal(signal.SIGKILL)
        victim.wait()
    wait_for(lambda: running_programs() == {}, "the dead one to be forgotten")
    assert list(folder().iterdir()) == []


def visit() -> socket.socket:
    """A client connected to our own socket that has sent nothing yet."""
    client = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    client.settimeout(PATIENCE_S)
    client.connect(str(folder() / f"{os.getpid()}.sock"))
    return client


def serve(asked: Mapping[str, Any]) -> Mapping[str, Any]:
    if asked.get("port") == "broken":
        raise RuntimeError("no page today")
    return {"url": f"{asked['address']}:{int(asked['port'])}"}


@pytest.mark.parametrize(
    "line",
    [
        *(b"[" * 4000, b'{"a":' * 900, b'{"port": Infinity, "address": 1}', b'{"port": ' + b"9" * 4000, b'"\xff'),
        *(b"[1]", b"7", b"null", b"\0", b'{"port": 1}', b'{"port": [], "address": {}}'),
    ],
)
def test_whatever_is_said_the_next_is_answered(line: bytes) -> None:
    with ControlSocket("demo", serve):
        with visit() as client:
            client.sendall(line + b"\n")
            assert b"error" in client.makefile("rb").readline()
        assert request(os.getpid(), {"address": "x", "port": 3})["url"] == "x:3"


def test_an_answer_that_fails_is_told_and_the_next_is_answered() -> None:
    with ControlSocket("demo", serve):
        with pytest.raises(RunError, match="RuntimeError: no page today"):
            request(os.getpid(), {"port": "broken"})
        assert request(os.getpid(), {"address": "x", "port": 3})["url"] == "x:3"


@pytest.mark.parametrize("said", [b"", b'{"port":'])
@pytest.mark.parametrize("count", [5, 100])
def test_nobody_waits_for_those_who_do_not_speak(said: bytes, count: int) -> None:
    with ExitStack() as clients:
        with ControlSocket("demo", serve):
            silent = [clients.enter_context(visit()) for _ in range(count)]
            for client in silent:
                with suppress(BrokenPipeError):  # sent away, since more came than there is room for
                    client.sendall(said)
            assert request(os.getpid(), {"address": "x", "port": 3})["url"] == "x:3"
            silent[-1].setblocking(False)
            with pytest.raises(BlockingIOError):  # nobody sent it away for that
                silent[-1].recv(1)
        silent[-1].settimeout(PATIENCE_S)
        assert silent[-1].recv(1) == b""


def test_those_who_do_not_speak_are_sent_away(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gr_ros2.cli.control_socket._REQUEST_S", 0.01)
    with ControlSocket("demo", serve), visit() as client:
        assert client.recv(1) == b""


@pytest.mark.parametrize("ended", [True, False])
def test_a_line_may_come_in_pieces(ended: bool) -> None:
    with ControlSocket("demo", serve), visit() as client:
        for piece in (b'{"address": "x",', b' "port"', b": 3}" + b"\n" * ended):
            client.sendall(piece)
        if not ended:
            client.shutdown(socket.SHUT_WR)
        assert json.loads(client.makefile("rb").readline())["url"] == "x:3"


@pytest.mark.parametrize("answer", [b"[" * 4000 + b"\n", b"[]\n", b"7\n", b"\xff\n", b"", b"x" * 100_000])
def test_an_answer_that_is_none(answer: bytes) -> None:
    """Another program's socket with a name like ours."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as other:
        other.bind(str(folder() / "1.sock"))
        other.listen()

        def speak() -> None:
            for _ in range(2):
                with other.accept()[0] as client, suppress(OSError):
                    client.sendall(answer)

        thread = threading.Thread(target=speak)
        thread.start()
        assert running_programs() == {}
        with pytest.raises(RunError, match="process 1: does not answer"):
            request(1, {"x": 1})
        thread.join()


def test_an_answer_that_never_ends_is_not_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gr_ros2.cli.control_socket._WAIT_S", 0.3)
    left = threading.Event()
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as other:
        other.bind(str(folder() / "1.sock"))
        other.listen()

        def speak() -> None:
            with other.accept()[0] as client, suppress(OSError):
                while not left.wait(0.05):  # often enough that no single wait is long
                    client.sendall(b" ")

        thread = threading.Thread(target=speak)
        thread.start()
        with pytest.raises(RunError, match="timed out"):
            request(1, {"x": 1})
        left.set()
        thread.join()


def test_an_answer_that_came_while_this_program_was_frozen_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    """The clock has gone on for a minute when it looks again."""
    clock = iter([0.0, 0.0, 60.0, *[60.0] * 10])
    monkeypatch.setattr(control_socket, "time", SimpleNamespace(monotonic=lambda: next(clock)))
    here, there = socket.socketpair()
    with here, there:
        there.sendall(b"half ")
        assert control_socket.receive(here, 5, 5.0) == b"half "
        there.sendall(b"an answer\n")
        assert control_socket.receive(here, 100, 5.0, b"\n") == b"an answer\n"


def test_who_says_nothing_is_not_waited_for_any_longer(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter([0.0, 1.0, 2.0])
    monkeypatch.setattr(control_socket, "LOOK_S", 0.001)
    monkeypatch.setattr(control_socket, "time", SimpleNamespace(monotonic=lambda: next(clock)))
    here, there = socket.socketpair()
    with here, there, pytest.raises(TimeoutError):
        control_socket.receive(here, 100, 2.0, b"\n")
