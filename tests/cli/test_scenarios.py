"""`scenarios`: one line each."""

from __future__ import annotations

import pytest

from gr_ros2.cli.main import run
from gr_ros2.run.scenario import load_scenario
from gr_ros2.settings.files import builtin_scenarios


def test_one_line_each(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["scenarios"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == [load_scenario(name).name for name in builtin_scenarios()]
    assert all(len(line) < 120 and len(line.split()) > 3 for line in lines)
