"""gr-ros2 where GNU Radio is not installed: what needs none works, and what needs it says so in one line."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
DRIVE = ROOT / "tests" / "data" / "simulated_drive"
PROGRAM = """
import json, sys

class NotInstalled:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ("gnuradio", "pmt"):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, NotInstalled())
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from gr_ros2.cli.main import run
said = []
for words in json.load(sys.stdin):
    with redirect_stdout(StringIO()) as out, redirect_stderr(StringIO()) as err:
        status = run(words)
    said.append((status, out.getvalue(), err.getvalue()))
json.dump(said, sys.stdout)
"""


def commands(folder: Path, *commands: tuple[str, ...]) -> list[tuple[int, str, str]]:
    """Run commands one after another in one process: the status of each, and what it says and complains."""
    given = json.dumps(commands)
    done = subprocess.run([sys.executable, "-c", PROGRAM], cwd=folder, input=given, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return [(status, out, err) for status, out, err in json.loads(done.stdout)]


@pytest.mark.slow
def test_what_needs_none_works(tmp_path: Path) -> None:
    topics = "/robot_1/odom,/robot_1/scan"
    link = ("--scenario", "paper-direct", "--topics", topics, "--set", "time=packets", "--duration", "3")
    done = commands(
        tmp_path,
        ("plan", "demo", "--set", "phy.name=modem"),
        ("registry", "from-bag", str(DRIVE)),
        ("run", "paper-direct", "--set", "time=packets", "--duration", "2", "--out", "run"),
        ("replay", str(DRIVE), "out.mcap", *link),
        ("registry", "from-bag", "out.mcap"),
    )
    assert [(status, err) for status, _, err in done] == [(0, "")] * 5
    assert "nav_msgs/msg/Odometry" in done[-1][1]


@pytest.mark.slow
def test_what_needs_it_says_so_in_one_line(tmp_path: Path) -> None:
    said = {
        ("demo", "--out", "run"): "phy 'ofdm' needs GNU Radio 3.10 (apt install gnuradio)",
        ("race", "--short"): "this needs GNU Radio 3.10",
        ("plan", "demo"): "phy 'ofdm' needs GNU Radio 3.10 (apt install gnuradio)",
        ("link", "--robot", "1", "--radio", "udp", "--listen", "0", "--peer", "127.0.0.1:9"): "GNU Radio 3.10",
    }
    for line, (status, _, err) in zip(said.values(), commands(tmp_path, *said), strict=True):
        assert status == 2, err
        assert line in err.splitlines()[-1]
        assert "Traceback" not in err
