"""A home directory that cannot be written, as that of a service: GNU Radio's refusal becomes a line with the remedy."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")

from gr_ros2.cli import main
from gr_ros2.core import preferences
from gr_ros2.core.errors import PhyError
from gr_ros2.doctor import installed

NOWHERE = "/proc/none"
"""No folder can be made there, even by root."""


def test_a_home_that_cannot_be_written_is_one_line_with_the_remedy(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "gr_ros2.cli", "run", "paper-ofdm-paced", "--duration", "1", "--out", str(tmp_path)],
        env={**os.environ, "HOME": NOWHERE, "XDG_CACHE_HOME": NOWHERE, "XDG_CONFIG_HOME": NOWHERE},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 1
    (line,) = (line for line in done.stderr.splitlines() if line.startswith("gr-ros2:"))
    assert f"HOME = {NOWHERE} cannot be written" in line
    assert "HOME=/var/tmp/gr-ros2" in line
    assert "Traceback" not in done.stderr


def test_the_doctor_says_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("HOME", "XDG_CACHE_HOME", "XDG_CONFIG_HOME"):
        monkeypatch.setenv(name, NOWHERE)
    found = installed.gnu_radio()
    assert found.state == "failed"
    assert NOWHERE in found.text
    assert found.remedy.startswith("set HOME to")


def test_nothing_is_tried_where_home_can_be_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(preferences, "TRIAL", "raise SystemExit('tried')")
    monkeypatch.setenv("HOME", str(tmp_path))
    preferences.check_preferences()
    monkeypatch.setenv("HOME", NOWHERE)
    with pytest.raises(PhyError, match="tried"):
        preferences.check_preferences()


def test_a_version_of_gnu_radio_that_needs_no_home_is_not_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(preferences, "TRIAL", "")
    monkeypatch.setenv("HOME", NOWHERE)
    preferences.check_preferences()


def test_a_home_that_cannot_be_read_is_refused_before_gnu_radio_is_imported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def refuse(path: Path) -> None:  # as for another user than root
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.delenv("XDG_CONFIG_HOME", raising=False)
    assert main.run(["scenarios"]) == 0  # a home in which GNU Radio has kept nothing yet
    monkeypatch.setattr(preferences.Path, "stat", refuse)
    assert main.run(["doctor"]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"gr-ros2: HOME = {tmp_path} cannot be read, and GNU Radio keeps its preferences there")
