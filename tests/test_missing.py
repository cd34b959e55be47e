"""A module of tests that imports what is not installed is skipped, and every other error of an import is one."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
HIDDEN = """
import sys
sys.modules |= dict.fromkeys(["gnuradio", "pmt"])
import pytest
sys.exit(pytest.main(sys.argv[1:]))
"""
"""Runs pytest where GNU Radio is not installed."""


@pytest.mark.parametrize(
    ("imports", "said"),
    [
        ("from gr_ros2.gr import RosLink", "needs GNU Radio 3.10"),
        ("import gnuradio.blocks", "needs GNU Radio 3.10"),
        ("import gr_ros2.nosuch", "ModuleNotFoundError: No module named 'gr_ros2.nosuch'"),
        ("from gr_ros2.core import nosuch", "ImportError: cannot import name 'nosuch'"),
    ],
)
def test_what_is_not_installed_skips_a_module_and_nothing_else_does(tmp_path: Path, imports: str, said: str) -> None:
    path = tmp_path / "test_needs.py"
    path.write_text(f"{imports}\n\n\ndef test_nothing(): assert True\n")
    words = ["-q", "-rs", "-p", "tests.missing", "-p", "no:cacheprovider", f"--rootdir={tmp_path}", str(path)]
    done = subprocess.run(
        [sys.executable, "-c", HIDDEN, *words],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )
    assert said in done.stdout, done.stdout + done.stderr
    assert ("1 skipped" in done.stdout) == said.startswith("needs")
