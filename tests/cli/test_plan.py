"""`gr-ros2 plan` says whether the traffic fits and what to change."""

from __future__ import annotations

import re

import pytest

pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")

from gr_ros2.cli.main import BAD_INPUT, run


def test_it_says_what_fits(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["plan", "paper-ofdm-paced", "--duration", "3"]) == 0
    out = capsys.readouterr().out
    assert "a packet of 64 B takes 13.12 ms, 76.2 packets/s" in out
    assert "/robot_1/odom" in out
    assert ": it fits." in out


def test_it_says_what_does_not_fit_and_what_to_change(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["plan", "paper-ofdm-paced", "--duration", "3", "--set", "ros_source.compression=false"]) == 0
    out = capsys.readouterr().out
    assert "it does not fit, most of it is /robot_1/odom" in out
    assert "Better: --set ros_source.compression=true" in out


def test_it_says_what_gets_better_by_how_much_and_what_gets_worse(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["plan", "demo", "--duration", "5", "--set", "ros_source.compression=false"]) == 0
    lines = [line for line in capsys.readouterr().out.splitlines() if " --set " in line]
    assert lines
    for line in lines:
        assert re.match(r"(Better|A trade): --set .*: \d+% of the airtime", line)
        assert ("; no topic gets worse" in line) == line.startswith("Better")
        assert (" older: " in line or " less of " in line) == line.startswith("A trade")
    assert re.search(r"younger: /robot_1/\w+ \d+ to \d+ ms \(-\d+%\)", lines[0])


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
        "gr-ros2: version = 0: has nothing to choose by, as the paper has it; set version: 1 for a plan\n"
    )
