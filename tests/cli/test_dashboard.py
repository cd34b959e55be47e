"""`--dashboard` and `gr-ros2 dashboard`: where, and what is said when it cannot be."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
import urllib.request
from pathlib import Path

import pytest

from gr_ros2.cli.dashboard import parse_place
from gr_ros2.cli.main import run
from gr_ros2.core.errors import ConfigError
from tests.programs import ProgramProcess, run_program
from tests.waiting import PATIENCE_S


@pytest.mark.parametrize(
    ("text", "place"),
    [
        ("5006", ("127.0.0.1", 5006)),
        ("0", ("127.0.0.1", 0)),
        ("0.0.0.0:80", ("0.0.0.0", 80)),
        ("*:80", ("0.0.0.0", 80)),
        ("0:80", ("0.0.0.0", 80)),
        ("[::1]:5006", ("::1", 5006)),
        (" robot.local:65535 ", ("robot.local", 65535)),
    ],
)
def test_a_place(text: str, place: tuple[str, int]) -> None:
    assert parse_place(text) == place


@pytest.mark.parametrize("text", ["", "demo", "65536", "-1", "1.5", "host:", "::1:80", "5006:host", "٣"])
def test_no_place(text: str) -> None:
    with pytest.raises(ConfigError, match="ADDRESS"):
        parse_place(text)


@pytest.fixture
def alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No other program of this user can be looked at."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))


@pytest.mark.usefixtures("alone")
def test_nothing_there(capsys: pytest.CaptureFixture[str]) -> None:
    with socket.socket() as held:  # bound and not listening: nobody answers, nobody else takes it
        held.bind(("127.0.0.1", 0))
        port = held.getsockname()[1]
        assert run(["dashboard", str(port), "--no-browser"]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert f"127.0.0.1:{port}: no dashboard there" in line


def test_a_page_that_is_there(capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("bokeh", reason="needs bokeh: pip install 'gr-ros2[dashboard]'")
    pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")
    from gr_ros2.dashboard.server import Dashboard

    with Dashboard(port=0) as served:
        assert run(["dashboard", str(served.port), "--no-browser"]) == 0
        assert capsys.readouterr().out.strip() == served.url


def test_without_bokeh_it_says_what_to_install(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")
    monkeypatch.delitem(sys.modules, "gr_ros2.dashboard.server", raising=False)
    monkeypatch.setitem(sys.modules, "bokeh.application", None)
    assert run(["run", "paper-direct", "--dashboard=0"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "bokeh" in line
    assert "gr-ros2[dashboard]" in line


def test_a_port_that_is_taken(capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("bokeh", reason="needs bokeh: pip install 'gr-ros2[dashboard]'")
    pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")
    with socket.socket() as held:
        held.bind(("127.0.0.1", 0))
        held.listen()
        assert run(["run", "paper-direct", f"--dashboard={held.getsockname()[1]}"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "choose another address or port" in line


MEMORY = ("--set", "graph.middleware=memory")


@pytest.mark.usefixtures("alone")
@pytest.mark.parametrize("what", ["run", "link"])
def test_beside_what_was_started_without(
    what: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("bokeh", reason="needs bokeh: pip install 'gr-ros2[dashboard]'")
    pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")
    config = tmp_path / "link.yaml"
    config.write_text("registry: odom\nrobot: /robot_1\nphy: {name: direct}\n")
    started = {
        "run": ["run", "paper-direct", "--no-report", "--out", str(tmp_path / "out")],
        "link": ["link", str(config)],
    }[what]
    command = [sys.executable, "-m", "gr_ros2.cli", *started, "--duration", "600", *MEMORY]
    with ProgramProcess(command, stdout=subprocess.DEVNULL) as running:
        try:
            # Where a computer is busy, a page is not made within the ten seconds for which a person would wait.
            monkeypatch.setattr("gr_ros2.cli.control_socket._WAIT_S", PATIENCE_S)
            assert run(["dashboard", "0", "--wait", str(PATIENCE_S), "--no-browser"]) == 0
            url = capsys.readouterr().out.strip()
            with urllib.request.urlopen(f"{url}alive") as answer:
                assert "instance" in json.load(answer)
            # Asked again, it says where it is.
            assert run(["dashboard", "0", "--pid", str(running.pid), "--no-browser"]) == 0
            assert capsys.readouterr().out.strip() == url
        finally:
            running.send_signal(signal.SIGINT)
            running.wait()


@pytest.mark.usefixtures("alone")
def test_who_serves_it_to_the_network_is_warned_and_told_the_real_address(tmp_path: Path) -> None:
    pytest.importorskip("bokeh", reason="needs bokeh: pip install 'gr-ros2[dashboard]'")
    pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")
    from gr_ros2.dashboard.addresses import own_addresses

    command = [sys.executable, "-m", "gr_ros2.cli", "run", "paper-direct", "--no-report", "--duration", "1", *MEMORY]
    out = str(tmp_path / "out")
    done = run_program([*command, "--dashboard=0.0.0.0:0", "--out", out], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert f"live at http://{own_addresses()[0]}:" in done.stdout
    (line,) = done.stderr.splitlines()
    assert "everybody on the network can open this page" in line
    quiet = run_program([*command, "--dashboard=0", "--out", f"{out}2"], capture_output=True, text=True)
    assert quiet.stderr == ""
