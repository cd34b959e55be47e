"""`gr-ros2 ablate` runs a scenario with one part off at a time."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")

from gr_ros2.cli.main import BAD_INPUT, run


def test_it_prints_what_each_part_is_worth_and_writes_the_page(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "parts"
    arguments = ["ablate", "paper-ofdm-paced", "--duration", "2", "--set", "time=packets", "--out", str(out)]
    assert run(arguments) == 0
    text = capsys.readouterr().out
    assert "no-compression: compression=false\n" in text
    (line,) = (line.split() for line in text.splitlines() if "PDR" in line)
    assert line[:3] == ["/robot_1/odom", "PDR", "1.00"]
    assert float(line[3]) < 0.5, "without compression"
    assert "What each part is worth" in (out / "compare.html").read_text()
    assert {path.name for path in out.iterdir() if path.is_dir()} == {
        "whole",
        "no-compression",
        "no-pull",
        "no-repair",
    }


def test_where_nothing_is_on_it_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["ablate", "paper-ofdm"]) == BAD_INPUT
    assert "nothing to switch off" in capsys.readouterr().err


def test_repetitions_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["ablate", "paper-ofdm-paced", "--set", "repetitions=2"]) == BAD_INPUT
    assert "repetitions = 2: each part is off once; set 1, or write a sweep" in capsys.readouterr().err


def test_of_a_team_it_says_whose_view_it_shows(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["ablate", "team", "--duration", "1", "--out", str(tmp_path / "parts")]) == 0
    assert "What each part is worth, as /robot_1 receives it" in capsys.readouterr().out
