"""Each check says what is wrong when it is: faults are made for real, in an environment or a process of their own."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import asdict
from importlib.util import find_spec
from pathlib import Path

import pytest

from gr_ros2.cli.main import run
from gr_ros2.doctor import checks, computer, installed, programs, radios, ros
from gr_ros2.doctor.checks import CHECKS
from gr_ros2.doctor.finding import Check, Finding, State
from gr_ros2.middleware import Qos
from gr_ros2.middleware.dds import DdsMiddleware
from tests.domains import free_domains
from tests.waiting import wait_for

ROOT = Path(__file__).resolve().parents[2]
LATER = "log in again"


def in_child(call: str, limit: str = ":", **environ: str) -> Finding:
    """What a check finds in a process of its own, behind a limit of the shell."""
    program = (
        "import json; from dataclasses import asdict; from gr_ros2.doctor import computer, installed, ros\n"
        f"found = {call}\n"
        "print('\\n' + json.dumps([asdict(f) for f in ([found] if hasattr(found, 'what') else found)]))"
    )
    command = ["/bin/sh", "-c", f'{limit}; exec "$0" -c "$1"', sys.executable, program]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), **environ}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    (finding,) = json.loads(done.stdout.splitlines()[-1])
    return Finding(**finding)


def test_python_is_named() -> None:
    assert installed.python().state == "ok"
    assert sys.executable in installed.python().text


def test_a_gnu_radio_that_cannot_be_imported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "gnuradio").mkdir()
    (tmp_path / "gnuradio" / "__init__.py").write_text("raise ImportError('built for another Python')")
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}{os.pathsep}{ROOT}")
    found = installed.gnu_radio()
    assert found.state == "failed"
    assert "built for another Python" in found.text
    assert "gnuradio" in found.remedy or "--system-site-packages" in found.remedy


@pytest.mark.parametrize(("version", "state"), [("3.10.5.1", "ok"), ("3.8.2.0", "failed")])
def test_the_version_of_gnu_radio(version: str, state: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "gnuradio").mkdir()
    (tmp_path / "gnuradio" / "__init__.py").touch()
    (tmp_path / "gnuradio" / "gr.py").write_text(f"version = lambda: {version!r}")
    (tmp_path / "pmt.py").touch()
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}{os.pathsep}{ROOT}")
    found = installed.gnu_radio()
    assert (found.state, found.text.partition(";")[0]) == (state, version)


def test_compiled_kernels(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    from gr_ros2.phy.kernels import library

    monkeypatch.setattr(installed, "loaded", lambda: library.load(tmp_path))  # a folder where none were built
    assert installed.kernels().state == "warning"
    assert "g++" in installed.kernels().remedy


def test_back_ends_that_are_missing_say_what_they_need(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gr_ros2.middleware.zenoh", None)
    found = {finding.what: finding for finding in installed.middleware()}
    assert found["middleware memory"].state == "ok"
    for finding in found.values():
        assert finding.state != "ok" or not finding.remedy
        assert finding.state == "ok" or finding.remedy
    assert found["middleware zenoh"].state == "note"
    assert found["middleware zenoh"].remedy.startswith("pip install eclipse-zenoh")


def test_a_module_that_a_phy_needs_when_it_is_used_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")
    monkeypatch.setitem(sys.modules, "ieee802_11", None)
    found = {finding.what: finding for finding in installed.phys()}["phy wifi"]
    assert found.state == "note"
    assert "ieee802_11" in found.text
    assert "https://github.com/bastibl/gr-ieee802-11" in found.remedy


def test_flowgraphs_that_do_not_find_the_blocks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    found = installed.companion()
    # Where the blocks are installed for everybody, they are found all the same.
    assert (found.state, found.remedy) in (("note", "gr-ros2 grc-path --install"), ("ok", ""))


def test_a_radio_on_usb_and_whether_it_may_be_opened(tmp_path: Path) -> None:
    device, node = tmp_path / "sys" / "1-1", tmp_path / "dev" / "001" / "007"
    device.mkdir(parents=True)
    for name, value in {"idVendor": "0456", "idProduct": "b673", "busnum": "1", "devnum": "7"}.items():
        (device / name).write_text(f"{value}\n")
    (tmp_path / "sys" / "usb1").mkdir()  # a hub
    (found,) = radios.usb(device.parent, tmp_path / "dev")
    assert (found.state, "ADALM-Pluto" in found.text) == ("warning", True)
    assert "plugdev" in found.remedy
    node.parent.mkdir(parents=True)
    node.touch()
    (found,) = radios.usb(device.parent, tmp_path / "dev")
    assert found.state == "ok"
    (found,) = radios.usb(tmp_path / "nothing", tmp_path / "dev")
    assert found.state == "note"


def test_without_the_vendors_programs(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")
    monkeypatch.setenv("PATH", "")
    found = list(radios.programs())
    assert {finding.state for finding in found} == {"note"}
    assert {finding.remedy for finding in found} == {
        f"sudo apt install {package}" for package in radios.PACKAGES.values()
    }


@pytest.mark.parametrize(
    ("says", "state"),
    [("No devices found", "note"), ("", "note"), ("  driver=hackrf\n  label = HackRF One", "ok")],
)
def test_what_the_vendors_programs_find(says: str, state: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")
    for name in radios.PACKAGES:
        (tmp_path / name).write_text(f"#!/bin/sh\necho '{says}'\n")
        (tmp_path / name).chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    found = list(radios.programs())
    assert {finding.state for finding in found} == {state}
    assert all("driver=hackrf" in finding.text for finding in found) or state == "note"


def test_a_program_that_hangs_is_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "hangs").write_text("#!/bin/sh\nexec sleep 1000\n")
    (tmp_path / "hangs").chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setattr(programs, "PATIENCE_S", 0.1)
    check = Check("Radios", "hangs", lambda: Finding("hangs", "ok", programs.output_of(["hangs"]) or ""))
    (found,) = check.findings()
    assert (found.state, found.what) == ("warning", "hangs")
    assert "has not ended after 0.1 s" in found.text


def test_which_ros_is_sourced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("ROS_DISTRO", raising=False)
    assert ros.distribution(tmp_path).text == f"none in {tmp_path}; the embedded DDS needs none"
    (tmp_path / "jazzy").mkdir()
    (tmp_path / "jazzy" / "setup.bash").touch()
    found = ros.distribution(tmp_path)
    assert (found.state, found.remedy) == ("note", f"source {tmp_path}/jazzy/setup.bash")
    if find_spec("rclpy") is None:
        monkeypatch.setenv("ROS_DISTRO", "jazzy")
        found = ros.distribution(tmp_path)
        assert (found.state, "finds no rclpy" in found.text) == ("warning", True)


@pytest.mark.parametrize(
    ("name", "state"), [("", "ok"), ("rmw_fastrtps_cpp", "ok"), ("rmw_zenoh_cpp", "note"), ("rmw_x", "warning")]
)
def test_the_rmw(name: str, state: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RMW_IMPLEMENTATION", name)
    assert ros.rmw().state == state


@pytest.mark.parametrize(
    ("environ", "said"),
    [
        ({"ROS_DOMAIN_ID": "999"}, "999"),
        ({"ROS_DOMAIN_ID": "one"}, "one"),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "MOON", "ROS_LOCALHOST_ONLY": ""}, "MOON"),
    ],
)
def test_an_environment_that_ros_could_not_read(environ: dict[str, str], said: str) -> None:
    found = in_child("ros.domain()", **environ)
    assert (found.state, said in found.text) == ("failed", True)
    assert found.remedy.startswith("unset ROS_DOMAIN_ID")
    assert in_child("ros.graph()", **environ).state == "failed"


def test_what_is_on_the_graph(monkeypatch: pytest.MonkeyPatch) -> None:
    (number,) = free_domains(1)
    monkeypatch.setenv("ROS_DOMAIN_ID", str(number))
    monkeypatch.setattr(ros, "_LOOK_S", 0.2)
    (found,) = ros.graph()
    assert (found.state, "nothing is published" in found.text) == ("note", True)
    with DdsMiddleware() as robot:
        robot.advertise("/robot_1/odom", "nav_msgs/Odometry", Qos(depth=1))
        wait_for(lambda: next(iter(ros.graph())).state == "ok", "the topic")
        (found,) = ros.graph()
    assert "/robot_1/odom [nav_msgs/msg/Odometry]" in found.text


@pytest.mark.parametrize(("year", "state"), [(1970, "failed"), (2030, "ok"), (2106, "failed")])
def test_a_date_that_cannot_be(year: int, state: str, monkeypatch: pytest.MonkeyPatch) -> None:
    from datetime import datetime, timezone

    class Clock(datetime):  # setting the computer's own would harm every other program
        @classmethod
        def now(cls, tz: object = None) -> datetime:  # noqa: ARG003
            return datetime(year, 6, 1, tzinfo=timezone.utc)

    monkeypatch.setattr(computer, "datetime", Clock)
    assert computer.date().state == state


def test_the_clock_is_looked_at() -> None:
    assert computer.synchronised().state in ("ok", "warning", "note")
    drift = computer.drift()
    assert drift.state in ("ok", "warning")
    assert "us in 0.5 s" in drift.text


def test_a_clock_that_is_set_meanwhile(monkeypatch: pytest.MonkeyPatch) -> None:
    true = computer.time.time
    shown = iter([0.0, 2.0])
    monkeypatch.setattr(computer.time, "time", lambda: true() + next(shown))
    assert computer.drift().state == "warning"


@pytest.mark.parametrize(("name", "option"), [("memlock", "-l 64"), ("nofile", "-n 100")])
def test_limits_of_the_shell(name: str, option: str) -> None:
    call = f"[f for f in computer.limits() if f.what == '{name}']"
    found = in_child(call, limit=f"ulimit {option}")
    assert (found.state, found.remedy.endswith(LATER)) == ("warning", True)
    assert f"'* - {name} " in found.remedy


def test_shared_memory_that_is_used_up(tmp_path: Path) -> None:
    (finding,) = computer.shared_memory()
    assert "segments in use" in finding.text
    (tmp_path / "sys" / "kernel").mkdir(parents=True)
    (tmp_path / "sysvipc").mkdir()
    (tmp_path / "sys" / "kernel" / "shmmni").write_text("4096\n")
    for used, state in ((10, "ok"), (3500, "warning"), (4096, "failed")):
        (tmp_path / "sysvipc" / "shm").write_text("head\n" + "row\n" * used)
        (finding,) = computer.shared_memory(tmp_path)
        assert (finding.state, "ipcrm" in finding.remedy) == (state, state != "ok")


def test_a_processor_that_saves_power(tmp_path: Path) -> None:
    assert computer.governor(tmp_path).state == "note"
    for number, name in enumerate(("performance", "powersave")):
        folder = tmp_path / f"cpu{number}" / "cpufreq"
        folder.mkdir(parents=True)
        (folder / "scaling_governor").write_text(f"{name}\n")
        found = computer.governor(tmp_path)
        assert found.state == ("ok" if name == "performance" else "warning")
    assert "cpupower" in found.remedy


def test_small_socket_buffers(tmp_path: Path) -> None:
    (tmp_path / "rmem_max").write_text("212992\n")
    (tmp_path / "wmem_max").write_text("8000000\n")
    small, large = computer.buffers(tmp_path)
    assert (small.state, large.state) == ("note", "ok")
    assert small.remedy == "sudo sysctl -w net.core.rmem_max=2500000"


@pytest.mark.parametrize(("value", "state"), [("", "ok"), ("-1", "ok"), ("8192", "warning")])
def test_a_limit_on_message_ports(value: str, state: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GR_CONF_DEFAULT_MAX_MESSAGES", value)
    assert computer.message_ports().state == state


def test_a_check_that_breaks_is_a_finding_and_the_others_go_on() -> None:
    def breaks() -> Finding:
        raise OSError("no such bus")

    (found,) = Check("Radios", "bus", breaks).findings()
    assert found == Finding("bus", "warning", "could not be looked at (OSError: no such bus)")


def test_every_check_has_its_own_name() -> None:
    assert len({check.name for check in CHECKS}) == len(CHECKS)
    assert len({check.look for check in CHECKS}) == len(CHECKS)


def test_every_check_is_told(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(ros, "_LOOK_S", 0.01)
    monkeypatch.setattr(computer, "_MEASURED_S", 0.01)
    status = run(["doctor", "--json"])
    told = json.loads(capsys.readouterr().out)
    failed = [finding for finding in told["findings"] if finding["state"] == "failed"]
    assert (status, told["ok"]) == ((1, False) if failed else (0, True))
    assert {finding["group"] for finding in told["findings"]} == {check.group for check in CHECKS}


@pytest.mark.parametrize(
    ("state", "status", "last"),
    [
        ("ok", 0, "A link runs here."),
        ("note", 0, "A link runs here."),
        ("warning", 0, "A link runs here; it would run better with: clock."),
        ("failed", 1, "A link does not run here: clock."),
    ],
)
def test_text_and_json_say_the_same(
    state: State, status: int, last: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    finding = Finding("clock", state, "it is [late]", "wind it up")
    monkeypatch.setattr(checks, "CHECKS", (Check("Clock", "clock", lambda: finding),))
    assert run(["doctor", "--json"]) == status
    told = json.loads(capsys.readouterr().out)
    assert told == {"ok": not status, "findings": [{"group": "Clock", **asdict(finding)}]}
    assert run(["doctor"]) == status
    heading, line, remedy, end = filter(None, capsys.readouterr().out.splitlines())
    assert (heading, remedy.strip(), end) == ("Clock", "mend: wind it up", last)
    assert line.lower().split() == [state, "clock:", "it", "is", "[late]"]
