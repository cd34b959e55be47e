"""`grc-path`: the folder GRC needs."""

from __future__ import annotations

from pathlib import Path

import pytest

from gr_ros2.cli.main import run


def test_it_prints_a_folder_of_block_descriptions(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["grc-path"]) == 0
    folder = Path(capsys.readouterr().out.strip())
    assert sorted(path.name for path in folder.glob("*.block.yml"))
