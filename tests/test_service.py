"""The systemd template of the Debian package: systemd understands it, and links that it starts are found and end."""

from __future__ import annotations

import os
import re
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest

from gr_ros2.cli import control_socket
from gr_ros2.cli.status import status_of
from gr_ros2.state.keys import new_key_file
from tests.domains import free_ports
from tests.waiting import PATIENCE_S

ROOT = Path(__file__).resolve().parents[1]
UNIT = ROOT / "debian" / "gr-ros2@.service"
PROGRAM = "/usr/bin/gr-ros2"


def settings(instance: str) -> dict[str, list[str]]:
    """What the unit says of one link."""
    found: dict[str, list[str]] = {}
    for line in UNIT.read_text().replace("%i", instance).splitlines():
        name, equals, value = line.partition("=")
        if equals and not line.startswith("#"):
            found.setdefault(name, []).append(value)
    return found


def test_systemd_understands_every_line(tmp_path: Path) -> None:
    if shutil.which("systemd-analyze") is None:
        pytest.skip("systemd-analyze is not installed")
    unit = tmp_path / "gr-ros2@front.service"

    def complaints(text: str) -> str:
        assert PROGRAM in text
        unit.write_text(text.replace(PROGRAM, shutil.which("true") or ""))  # the package need not be installed
        done = subprocess.run(
            ["systemd-analyze", "verify", "--man=no", unit], capture_output=True, text=True, check=False
        )
        return "\n".join(line for line in done.stderr.splitlines() if unit.name in line or unit.stem in line)

    assert complaints(UNIT.read_text()) == ""
    assert "RestartSecs" in complaints(UNIT.read_text().replace("RestartSec=", "RestartSecs="))


def test_who_runs_it_is_made_and_what_it_needs_is_installed() -> None:
    postinst = (ROOT / "debian" / "gr-ros2.postinst").read_text()
    (user,) = settings("x")["User"]
    assert re.search(rf"^ *adduser --system --group .* {user}$", postinst, re.MULTILINE)
    assert re.search(r"^(Depends:| ) *adduser,$", (ROOT / "debian" / "control").read_text(), re.MULTILINE)
    assert subprocess.run(["sh", "-n", ROOT / "debian" / "gr-ros2.postinst"], check=False).returncode == 0


class Service:
    """A link that runs with the settings of the unit, below another root folder.

    :param number: of its robot
    """

    def __init__(self, root: Path, number: int, own: int, other: int) -> None:
        instance = f"radio{number}"
        unit = settings(instance)
        configuration = root / "etc/gr-ros2"
        self.state, runtime = root / "var/lib" / unit["StateDirectory"][0], root / "run" / unit["RuntimeDirectory"][0]
        for folder in (self.state, runtime):
            folder.mkdir(parents=True)
        (configuration / f"{instance}.yaml").write_text(
            f"robot: /robot_{number}\ntopics: [odom]\ngraph: {{middleware: memory}}\nkey: fleet.key\n"
            "phy: {name: modem, options: {bit_rate: 1000000}}\n"
            f"front_end: {{name: udp, listen: '127.0.0.1:{own}', send_to: ['127.0.0.1:{other}']}}\n"
        )
        self._notices = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._notices.bind(str(runtime / "notify"))
        self._notices.settimeout(PATIENCE_S)
        (command,) = unit["ExecStart"]
        words = command.removeprefix(f"{PROGRAM} ").replace("/etc/", f"{root}/etc/").split()
        given = dict(line.split("=", 1) for line in unit["Environment"])
        self.process = subprocess.Popen(
            [sys.executable, "-m", "gr_ros2.cli", *words],
            env={
                "PATH": os.environ["PATH"],
                "PYTHONPATH": str(ROOT),
                "NOTIFY_SOCKET": str(runtime / "notify"),
                **{name: f"{root}{path}" for name, path in given.items()},
            },
            cwd=f"{root}{unit['WorkingDirectory'][0]}",
        )
        self._ends_well = {0, *map(int, unit["SuccessExitStatus"])}

    def is_ready(self) -> bool:
        return self._notices.recv(200) == b"READY=1"

    def end(self, number: int) -> bool:
        """Whether it ends by a signal, and systemd takes that for a success."""
        self.process.send_signal(number)
        return self.process.wait(PATIENCE_S) in self._ends_well


@pytest.fixture
def root() -> Iterator[Path]:
    """A root folder with a short path, since that of a socket has at most 107 characters."""
    with TemporaryDirectory() as folder:
        yield Path(folder)


def test_two_links_of_one_machine_are_found_by_root_and_end(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")
    ports = free_ports(2)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(root))
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    patterns = tuple(f"{root}/{pattern}".lstrip("/") for pattern in control_socket._OF_OTHERS)
    monkeypatch.setattr(control_socket, "_OF_OTHERS", patterns)
    (root / "etc/gr-ros2").mkdir(parents=True)
    new_key_file(root / "etc/gr-ros2/fleet.key")
    services = [Service(root, 1, *ports), Service(root, 2, *reversed(ports))]
    try:
        assert all(service.is_ready() for service in services)
        assert {status_of(service.process.pid)["name"] for service in services} == {"radio1", "radio2"}
        files = [sorted(path.name for path in service.state.rglob("robot_*.json")) for service in services]
        assert files == [["robot_1.json"], ["robot_2.json"]]
        assert services[0].end(signal.SIGTERM)
        assert services[1].end(signal.SIGINT)
        assert control_socket.sockets() == {}
    finally:
        for service in services:
            service.process.kill()
            service.process.wait()


def test_a_wrong_setting_is_not_tried_for_ever(tmp_path: Path) -> None:
    (tmp_path / "x.yaml").write_text("robot: 1\npacket_len: many\n")
    done = subprocess.run(
        [sys.executable, "-m", "gr_ros2.cli", "link", str(tmp_path / "x.yaml")], capture_output=True, check=False
    )
    assert settings("x")["RestartPreventExitStatus"] == [str(done.returncode)] == ["2"]
