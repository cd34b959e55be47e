"""`gr-ros2 replay` and `gr-ros2 losses` as one types them."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")

from gr_ros2.cli.main import run
from gr_ros2.middleware.bag_files import read_bag
from tests.lab.run.test_replay import COUNT, make_bag

REPORTS, LOSS = "robots=[{}, {topics: []}]", "channel.packet_loss=0.2"


@pytest.fixture(autouse=True)
def cache(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))


def test_a_bag_goes_through_a_link(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = make_bag(tmp_path / "in", {"/a": "std_msgs/msg/String", "/b": "std_msgs/msg/String"})
    target = tmp_path / "out.mcap"
    command = ["replay", str(source), str(target), "--scenario", "paper-direct", "--topics", "a"]
    assert run([*command, "--set", "channel.packet_loss=0.5", "--seed", "3"]) == 0
    printed = capsys.readouterr().out
    assert "Carried: /a; left out: /b" in printed
    assert "lost_fragments" in printed
    assert 0 < len(list(read_bag(target))) < COUNT
    assert run(command) == 2
    assert "exists already" in capsys.readouterr().err


def test_half_a_second_is_a_part_of_it(tmp_path: Path) -> None:
    source = make_bag(tmp_path / "in", {"/a": "std_msgs/msg/String"})
    command = ["replay", str(source), str(tmp_path / "out"), "--scenario", "paper-direct", "--duration", "0.5"]
    assert run(command) == 0
    assert len(list(read_bag(tmp_path / "out"))) == 25


def test_losses_are_measured_and_shown(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["losses", "paper-ofdm", "--set", "phy.name=gfsk", "--set", "phy.options={}", "--set", "packet_len=33"]
    assert run([*command, "--from", "30", "--to", "30.2", "--packets", "50", "--out", str(tmp_path)]) == 0
    lines = [line.split() for line in capsys.readouterr().out.splitlines() if "50" in line]
    assert lines == [
        ["no", "noise", "50", "50", "1.0000"],
        ["30", "50", "50", "1.0000"],
        ["30.5", "50", "50", "1.0000"],
    ]
    assert [path.name[:8] for path in tmp_path.glob("*.json")] == ["gfsk-33-"]


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["paper-direct"], "phy.name = 'direct': has no samples"),
        (["paper-ofdm", "--from", "9", "--to", "3"], "--from 9 --to 3"),
        (["paper-ofdm", "--packets", "0"], "0 is not in the range"),
    ],
)
def test_wrong_settings_of_losses_are_one_line(
    arguments: list[str], complaint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["losses", *arguments]) == 2
    message = capsys.readouterr().err
    assert complaint in message
    assert message.count("\n") == 1


def test_replay_repairs_what_is_lost(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = make_bag(tmp_path / "in", {"/a": "std_msgs/msg/String"})
    command = ["replay", str(source), "--scenario", "paper-ofdm-paced", "--topics", "a"]
    assert run([*command, str(tmp_path / "out.mcap"), "--set", REPORTS, "--set", LOSS]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert re.search(r"the channel of robot 1 \d+% of the time \(new messages \d+%, repair \d+%", printed), printed
    assert re.search(r"the channel back \d+% of the time \(reports \d+%", printed)
    assert " first Topic sent try repaired " in printed
    assert len(list(read_bag(tmp_path / "out.mcap"))) == COUNT
    assert run([*command, str(tmp_path / "lost.mcap"), "--set", "paper={}", "--set", "topics=auto", "--set", LOSS]) == 0
    assert "repair " not in capsys.readouterr().out
    assert len(list(read_bag(tmp_path / "lost.mcap"))) < COUNT
