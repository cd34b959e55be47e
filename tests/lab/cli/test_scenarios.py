"""`scenarios`: one line each."""

from __future__ import annotations

import pytest

from gr_ros2.cli.main import run
from gr_ros2_lab.run.builtin import builtin_scenarios
from gr_ros2_lab.run.scenario import load_scenario


def test_one_line_each(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["scenarios"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == [load_scenario(name).name for name in builtin_scenarios()]
    assert all(len(line) < 120 and len(line.split()) > 3 for line in lines)
