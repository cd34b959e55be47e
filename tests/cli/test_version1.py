"""Every command that takes a scenario takes one with version 1, and shows what repair did."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")

from gr_ros2.cli.main import run
from gr_ros2.middleware.bag_files import read_bag
from gr_ros2_lab.record.result import read_result
from tests.lab.run.test_replay import COUNT, make_bag
from tests.lab.study.sweeps import write_sweep_file

PLAIN = ("--set", "paper={}", "--set", "topics=auto")
LOSSY = ("--set", "robots=[{}, {topics: []}]", "--set", "channel.packet_loss=0.2")


def test_replay_repairs_what_is_lost(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = make_bag(tmp_path / "in", {"/a": "std_msgs/msg/String"})
    command = ["replay", str(source), "--scenario", "paper-ofdm-paced", "--topics", "a"]
    assert run([*command, str(tmp_path / "out.mcap"), *LOSSY]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert re.search(r"the channel of robot 1 \d+% of the time \(new messages \d+%, repair \d+%", printed), printed
    assert re.search(r"the channel back \d+% of the time \(reports \d+%", printed)
    assert " first Topic sent try repaired " in printed
    assert len(list(read_bag(tmp_path / "out.mcap"))) == COUNT
    assert run([*command, str(tmp_path / "lost.mcap"), *PLAIN, "--set", "channel.packet_loss=0.2"]) == 0
    assert "repair " not in capsys.readouterr().out
    assert len(list(read_bag(tmp_path / "lost.mcap"))) < COUNT


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_a_sweep_tabulates_repaired_messages_and_the_air(tmp_path: Path) -> None:
    pytest.importorskip("distributed", reason="needs Dask: pip install 'gr-ros2[sweep]'")
    parquet = pytest.importorskip("pyarrow.parquet")
    fixed = {"robots": [{}, {"topics": []}], "duration_s": 4}
    path = write_sweep_file(
        tmp_path, scenario="paper-ofdm-paced", set=fixed, grid={"channel.packet_loss": [0.0, 0.2]}, repetitions=1
    )
    out = tmp_path / "out"
    assert run(["sweep", str(path), "--workers", "1", "--out", str(out)]) == 0
    table = parquet.ParquetFile(out / "sweep.parquet").read().to_pylist()
    rows = [row for row in table if row["topic"] == "/robot_1/odom"]
    clean, lossy = sorted(rows, key=lambda row: row["channel.packet_loss"])
    assert clean["pdr"] == 1
    assert lossy["pdr"] >= 0.99
    assert clean["ledger_repaired"] == 0 < lossy["ledger_repaired"]
    assert clean["packets_air_repair"] == 0 < lossy["packets_air_repair"]


@pytest.mark.usefixtures("undrawn")
def test_ablation_tells_what_repair_is_worth(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "parts"
    command = ["ablate", "paper-ofdm-paced", "--duration", "4", "--set", "time=packets", "--out", str(out), *LOSSY]
    assert run(command) == 0
    (line,) = (line.split() for line in capsys.readouterr().out.splitlines() if " PDR " in line)
    parts = ["whole", "no-compression", "no-pull", "no-repair", "no-reports"]
    assert {path.name for path in out.iterdir() if path.is_dir()} == set(parts)
    pdr = dict(zip(parts, map(float, line[2:]), strict=True))
    assert pdr["whole"] >= 0.99
    assert 0.6 < pdr["no-repair"] < 0.95
    assert pdr["no-reports"] >= 0.95


def test_the_losses_of_a_radio_do_not_depend_on_the_version(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["losses", "paper-ofdm", "--set", "phy.name=gfsk", "--set", "phy.options={}", "--set", "packet_len=40"]
    command += ["--from", "6", "--to", "7", "--packets", "40"]
    shown = []
    for number, paper in enumerate(("{}", "null")):
        assert run([*command, "--out", str(tmp_path / str(number)), "--set", f"paper={paper}"]) == 0
        shown.append(capsys.readouterr().out.splitlines())
    assert any("no noise" in line and "1.0000" in line for line in shown[1])
    assert [line for line in shown[0] if "40" in line] == [line for line in shown[1] if "40" in line]


def test_a_plan_forecasts_repair_and_reports(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["plan", "paper-ofdm-paced", "--duration", "4", "--no-advice", *LOSSY]) == 0
    printed = capsys.readouterr().out
    told = re.search(r"Air in use: the channel of robot 1 (\d+)% .*; the channel back (\d+)% of the time", printed)
    assert told is not None, printed
    new, repair = (int(re.search(rf"{kind} (\d+)%", told[0])[1]) for kind in ("new messages", "repair"))  # type: ignore[index]
    assert new / 6 < repair < new
    assert int(told[1]) == pytest.approx(new + repair, abs=3)
    assert int(told[2]) > 0
    assert re.search(r"/robot_1/odom .* (1\.00|0\.99) ", printed)


def test_the_demo_speaks_version_1_unless_told_otherwise(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    demo = ["demo", "--duration", "0.5", "--no-report", "--set", "time=samples"]
    assert run([*demo, "--out", str(tmp_path / "new")]) == 0
    assert re.search(r"Air in use: .* the channel back", " ".join(capsys.readouterr().out.split()))
    assert run([*demo, "--out", str(tmp_path / "old"), "--wire", "0"]) == 0
    assert "the channel back" not in capsys.readouterr().out
    new, old = (read_result(tmp_path / name) for name in ("new", "old"))
    assert new.config["paper"] is None
    assert old.config["paper"] is not None
    assert any("lost_fragments" in topic.ledger for topic in old.topics)
