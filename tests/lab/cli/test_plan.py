"""`gr-ros2 plan` says whether the traffic fits and what to change."""

from __future__ import annotations

import re
import shlex
import signal
from multiprocessing import forkserver
from pathlib import Path

import pytest

pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")

from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.rosbag2.reader import zstd  # type: ignore[attr-defined]

from gr_ros2.cli.main import BAD_INPUT, run
from gr_ros2.middleware.dds import DdsMiddleware
from gr_ros2_lab.sim.fleet import Fleet
from gr_ros2_lab.sim.publisher import SimPublisher
from gr_ros2_lab.sim.sim_settings import SimSettings
from tests.domains import free_domains
from tests.middleware.foreign_bags import Foreign, unclosed

REPOSITORY = Path(__file__).resolve().parents[3]


def test_it_says_what_fits(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["plan", "paper-ofdm-paced", "--duration", "3"]) == 0
    out = capsys.readouterr().out
    assert "a packet of 64 B takes 13.12 ms, 76.2 packets/s" in out
    assert "/robot_1/odom" in out
    assert ": it fits." in out
    status = Path(f"/proc/{forkserver._forkserver._forkserver_pid}/status").read_text()
    blocked = re.search(r"SigBlk:\s*(\w+)", status)
    assert blocked is not None
    assert int(blocked[1], 16) >> (signal.SIGINT - 1) & 1, "Ctrl-C is for the process that waits, also during imports"


def test_it_says_that_it_does_not_try_a_task(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["plan", "formation", "--duration", "2", "--set", "robots=3", "--no-advice"]) == 0
    assert "gr-ros2 run says how well they do task 'formation' over this link" in capsys.readouterr().out


def test_room_on_the_air_is_not_enough_where_packets_collide(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["plan", "two-robots-half-duplex", "--set", "robots=4", "--duration", "5", "--no-advice"]) == 0
    out = capsys.readouterr().out
    said = re.search(r": the air has room for it, but only (\d+)% of the messages arrive, since packets", out)
    assert said is not None, out
    assert int(said[1]) < 50


def test_it_says_what_does_not_fit_and_what_to_change(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["plan", "paper-ofdm-paced", "--duration", "3", "--set", "compression=false"]) == 0
    out = capsys.readouterr().out
    assert "it does not fit, most of it is /robot_1/odom" in out
    assert "Better: --set compression=true" in out


def test_it_says_what_gets_better_by_how_much_and_what_gets_worse(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["plan", "demo", "--duration", "1", "--set", "compression=false"]) == 0
    lines = [line for line in capsys.readouterr().out.splitlines() if " --set " in line]
    assert lines
    for line in lines:
        assert re.match(r"(Better|A trade): --set .*: \d+% of the airtime", line)
        assert ("; no topic gets worse" in line) == line.startswith("Better")
        assert (" older: " in line or " less of " in line) == line.startswith("A trade")
    assert re.search(r"younger: /robot_1/\w+ \d+ to \d+ ms \(-\d+%\)", lines[0])


def test_it_says_what_a_camera_becomes(capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("av", reason="needs PyAV")
    assert run(["plan", "cameras", "--duration", "4", "--no-advice"]) == 0
    out = capsys.readouterr().out
    said = re.search(r"/robot_1/camera +H\.264 of (\d+) × (\d+) pixels.*? +([\d.]+) +(\d+) +(\d+) *\n", out)
    assert said is not None, out
    width, height, rate, kbit_s, age = map(float, said.groups())
    assert width / height == 4 / 3
    assert rate > 4
    assert 5 < kbit_s < 500
    assert age < 1000
    assert ": it fits." in out


def test_without_advice(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["plan", "paper-ofdm-paced", "--duration", "3", "--no-advice"]) == 0
    assert "Better" not in capsys.readouterr().out


def test_what_takes_no_airtime_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["plan", "paper-direct"]) == BAD_INPUT
    assert capsys.readouterr().err == (
        "gr-ros2: phy.name = 'direct': takes no airtime, so everything fits; set a radio\n"
    )


def test_version_0_has_nothing_to_plan(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["plan", "paper-ofdm"]) == BAD_INPUT
    assert capsys.readouterr().err == (
        "gr-ros2: paper: version 0 has nothing to choose by, as the paper has it; leave it out for a plan\n"
    )


OVERLOADED = ["plan", "six-topics-paced", "--duration", "4"]


def test_cuts_are_what_an_engineer_says_with_the_load_after_each(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(OVERLOADED) == 0
    out = capsys.readouterr().out
    before = int(re.search(r"New messages need (\d+)% of the air: it does not fit", out)[1])  # type: ignore[index]
    cuts = re.findall(r"^  (?:drop|limit) /robot_1/\w+(?: to [\d.]+ Hz)?: new messages need (\d+)%$", out, re.MULTILINE)
    loads = [before, *map(int, cuts)]
    assert loads == sorted(loads, reverse=True)
    assert loads[-1] <= 100 < loads[-2]
    assert "packet_len" not in out
    settings = shlex.split(re.search(r"^As settings: (.*)$", out, re.MULTILINE)[1])  # type: ignore[index]
    assert run([*OVERLOADED, *settings]) == 0
    assert f"New messages need {loads[-1]}% of the air: it fits." in capsys.readouterr().out


def test_a_bag_alone_or_over_a_link_is_planned(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    drive = str(REPOSITORY / "tests" / "data" / "simulated_drive")
    assert run(["plan", drive, "--no-advice", "--set", "phy.sample_rate=500000"]) == 0
    assert "psk at 500,000 samples/s" in capsys.readouterr().out
    saved = tmp_path / "saved.yaml"
    saved.write_text(
        "robot: 1\ngraph: {namespace: ''}\ntopics: [auto, -imu]\n"
        "phy: {name: gfsk, sample_rate: 200000}\nfront_end: {name: sim}\n"
    )
    assert run(["plan", str(saved), "--bag", drive, "--no-advice"]) == 0
    out = capsys.readouterr().out
    assert "gfsk at 200,000 samples/s" in out
    assert "odom" in out
    assert run(["plan", str(saved)]) == BAD_INPUT
    assert "which ones? --bag FILE or --graph" in capsys.readouterr().err
    assert run(["plan", "demo", "--graph"]) == BAD_INPUT
    assert "has no front_end, so it is no link" in capsys.readouterr().err


def test_recordings_as_others_leave_them(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "one.bag").write_bytes(b"#ROSBAG V2.0\n\xb3")
    with Writer(tmp_path / "empty", version=8, storage_plugin=StoragePlugin.MCAP):
        pass
    for name, says in (("one.bag", "is of ROS 1; make one of ROS 2"), ("empty", "has no topics that a link can carry")):
        assert run(["plan", str(tmp_path / name)]) == BAD_INPUT
        assert f"gr-ros2: bag {tmp_path / name}: {says}" in capsys.readouterr().err
    with Writer(tmp_path / "silent", version=8, storage_plugin=StoragePlugin.MCAP) as silent:
        silent.add_connection("/a", "std_msgs/msg/Int32", msgdef="int32 data", rihs01="RIHS01_" + "0" * 64)
    assert run(["plan", str(tmp_path / "silent")]) == BAD_INPUT
    assert "has no message of /a; set other topics, or record them again" in capsys.readouterr().err
    (tmp_path / "killed").mkdir()
    packed = tmp_path / "killed" / "in.mcap.zstd"
    packed.write_bytes(zstd.compress(unclosed(tmp_path / "in.mcap", [Foreign("/a")]).read_bytes()))
    for path in (packed, packed.parent):
        assert run(["plan", str(path), "--no-advice"]) == 0
        assert re.search(r"^ /a ", capsys.readouterr().out, re.MULTILINE)


def test_what_is_on_the_graph_now_is_planned(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gr_ros2_lab.study.traffic._LOOK_S", 0.5)
    (number,) = free_domains(1)
    words = ["plan", "--graph", "--duration", "2", "--no-advice", "--set", "graph.localhost_only=true"]
    words += ["--set", f"graph.domain_id={number}"]
    assert run(words) == BAD_INPUT
    assert "seen on the graph: no topics" in capsys.readouterr().err
    with DdsMiddleware(domain_id=number, localhost_only=True) as robot:
        sim = SimPublisher(Fleet(SimSettings(odom_rate=20)), robot, 60.0)
        sim.start()
        assert run(words) == 0
        sim.close()
    (line,) = (line.split() for line in capsys.readouterr().out.splitlines() if "/robot_1/odom" in line)
    assert float(line[1]) == pytest.approx(20, rel=0.3)
    assert line[2] == "724"


def test_a_plan_forecasts_repair_and_reports(capsys: pytest.CaptureFixture[str]) -> None:
    assert (
        run(
            [
                "plan",
                "paper-ofdm-paced",
                "--duration",
                "4",
                "--no-advice",
                "--set",
                "robots=[{}, {topics: []}]",
                "--set",
                "channel.packet_loss=0.2",
            ]
        )
        == 0
    )
    printed = capsys.readouterr().out
    told = re.search(r"Air in use: the channel of robot 1 (\d+)% .*; the channel back (\d+)% of the time", printed)
    assert told is not None, printed
    new, repair = (int(re.search(rf"{kind} (\d+)%", told[0])[1]) for kind in ("new messages", "repair"))  # type: ignore[index]
    assert new / 6 < repair < new
    assert int(told[1]) == pytest.approx(new + repair, abs=3)
    assert int(told[2]) > 0
    assert re.search(r"/robot_1/odom .* (1\.00|0\.99) ", printed)
