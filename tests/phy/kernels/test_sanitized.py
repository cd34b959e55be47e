"""The kernels under the address and undefined-behaviour sanitizers, over the corpus of their fuzz harness."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[3]
SKIPPED = 77


@pytest.mark.slow
def test_sanitizers_find_nothing() -> None:
    command = [sys.executable, str(ROOT / "tools" / "sanitize-kernels"), "20"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    if done.returncode == SKIPPED:
        pytest.skip(f"no C++ compiler with sanitizers: {done.stderr.strip()}")
    assert done.returncode == 0, done.stderr[-4000:]
    assert "nothing found" in done.stdout
