"""`gr-ros2 run`: repetitions, and what is told of them."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")

from gr_ros2.cli import main as command
from gr_ros2_lab.cli.params import new_results
from gr_ros2_lab.sim.sensors import TYPES

LOSSY = ["--duration", "1", "--set", "channel.packet_loss=0.02", "--set", "time=packets"]


@pytest.mark.usefixtures("undrawn")
def test_repetitions_end_in_means_and_one_report(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["run", "paper-direct", "--repetitions", "2", "--seed", "4", *LOSSY, "--out", str(tmp_path)]
    assert command.run(words) == 0
    out = capsys.readouterr().out
    assert "paper-direct: 2 runs" in out
    mean = json.loads((tmp_path / "repetitions.json").read_text())["topics"][0]["pdr"]["mean"]
    assert next(line for line in out.splitlines() if " PDR " in line).split()[2] == f"{mean:.3f}"
    assert f"Written to {tmp_path}: report.html, repetitions.json, the runs in rep-0 to rep-1" in out
    assert (tmp_path / "report.html").is_file()
    assert [json.loads((tmp_path / f"rep-{k}" / "result.json").read_text())["seed"] for k in (0, 1)] == [4, 5]


def test_one_repetition_is_a_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert (
        command.run(
            ["run", "paper-direct", "--repetitions", "1", *LOSSY, "--details", "--no-report", "--out", str(tmp_path)]
        )
        == 0
    )
    assert (tmp_path / "result.json").is_file()
    assert not (tmp_path / "repetitions.json").exists()
    out = capsys.readouterr().out
    assert "; 1 s of simulated time, " in out.splitlines()[0]
    assert "Where every sent message went" in out


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize("repetitions", [1, 2])
def test_a_report_can_wait(repetitions: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["run", "paper-direct", "--repetitions", str(repetitions), *LOSSY, "--out", str(tmp_path)]
    assert command.run([*words, "--no-report"]) == 0
    assert f"For the report: gr-ros2 report {tmp_path}\n" in capsys.readouterr().out
    assert not [*tmp_path.rglob("*.html"), *tmp_path.rglob("*.png"), *tmp_path.rglob("*.svg")]
    assert len([*tmp_path.rglob("result.json")]) == repetitions
    assert command.run(["report", str(tmp_path)]) == 0
    assert (tmp_path / "report.html").is_file()


def test_matplotlib_is_loaded_only_to_draw() -> None:
    program = "import sys, gr_ros2_lab.cli.run, gr_ros2.cli.dashboard; sys.exit('matplotlib' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program]).returncode == 0


def test_progress_is_told_where_the_output_is_no_terminal(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("gr_ros2_lab.cli.run.LOG_S", 0.0)
    words = ["run", "paper-direct", "--duration", "10", "--set", "time=packets", "--no-report", "--out", str(tmp_path)]
    assert command.run(words) == 0
    told = [line for line in capsys.readouterr().out.splitlines() if " s of 10 s, " in line]
    assert told
    assert all(re.fullmatch(r"paper-direct: \d+\.\d s of 10 s, \d+ sent, \d+ delivered", line) for line in told)


def test_a_demonstration_with_a_camera_shows_what_a_robot_sees(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("av", reason="needs PyAV")
    words = ["demo", "--camera", "--duration", "3", "--set", "time=packets", "--no-report", "--out", str(tmp_path)]
    assert command.run(words) == 0
    topics = {topic["topic"]: topic for topic in json.loads((tmp_path / "result.json").read_text())["topics"]}
    assert {name.rpartition("/")[2] for name in topics} == {*TYPES, "camera"}
    assert topics["/robot_1/camera"]["delivered"] > 10
    assert command.run(["demo", "--camera", "--robots", "3"]) != 0
    assert "--camera: leave --wire and --robots out" in capsys.readouterr().err


def test_runs_of_one_second_have_folders_of_their_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("gr_ros2_lab.cli.params.time.strftime", lambda _: "20260101-120000")
    found = [new_results(what) for what in ("a.b", "a.b", "a.b", "other")]
    assert [path.name for path in found] == [f"a.b-20260101-120000{end}" for end in ("", "-2", "-3")] + [
        "other-20260101-120000"
    ]
    assert all(path.is_dir() for path in found)


@pytest.mark.parametrize("words", [["ablate", "nosuch"], ["race", "--peers", "nosuch"]], ids=" ".join)
def test_a_typing_error_leaves_no_folder(
    words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert command.run(words) == command.BAD_INPUT
    assert "nosuch" in capsys.readouterr().err
    assert not list(tmp_path.glob("results/*"))


def test_a_report_that_is_written_elsewhere_leaves_no_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("a", "b"):
        words = ["run", "paper-direct", "--duration", "0.5", "--set", "time=packets", "--no-report", "--out", name]
        assert command.run(words) == 0
    assert command.run(["report", "a", "b", "--out", "both"]) == 0
    assert list(tmp_path.glob("both/*.html"))
    assert not (tmp_path / "results").exists()
