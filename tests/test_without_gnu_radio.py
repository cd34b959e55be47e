"""gr-ros2 where GNU Radio is not installed: what needs none works, and what needs it says so in one line."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
DRIVE = ROOT / "tests" / "data" / "simulated_drive"
PROGRAM = """
import sys

class NotInstalled:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ("gnuradio", "pmt"):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, NotInstalled())
from gr_ros2.cli.main import run
sys.exit(run())
"""


def command(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", PROGRAM, *words], cwd=folder, capture_output=True, text=True)


@pytest.mark.slow
@pytest.mark.parametrize(
    "words",
    [
        ("plan", "demo", "--set", "phy.name=modem"),
        ("registry", "from-bag", str(DRIVE)),
        ("run", "paper-direct", "--set", "time=packets", "--duration", "2", "--out", "run"),
    ],
    ids=lambda words: words[0],
)
def test_what_needs_none_works(words: tuple[str, ...], tmp_path: Path) -> None:
    done = command(tmp_path, *words)
    assert (done.returncode, done.stderr) == (0, ""), done.stderr


@pytest.mark.slow
def test_a_replay_by_packets(tmp_path: Path) -> None:
    topics = "/robot_1/odom,/robot_1/scan"
    link = ("--scenario", "paper-direct", "--topics", topics, "--set", "time=packets", "--duration", "3")
    done = command(tmp_path, "replay", str(DRIVE), "out.mcap", *link)
    assert done.returncode == 0, done.stderr
    counted = command(tmp_path, "registry", "from-bag", "out.mcap")
    assert "nav_msgs/msg/Odometry" in counted.stdout, counted.stderr


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("demo", "--out", "run"), "phy 'ofdm' needs GNU Radio 3.10 (apt install gnuradio)"),
        (("race", "--help"), "this needs GNU Radio 3.10"),
        (("plan", "demo"), "phy 'ofdm' needs GNU Radio 3.10 (apt install gnuradio)"),
        (("link", "--robot", "1", "--radio", "udp", "--listen", "0", "--peer", "127.0.0.1:9"), "GNU Radio 3.10"),
    ],
    ids=lambda value: value[0] if isinstance(value, tuple) else "",
)
def test_what_needs_it_says_so_in_one_line(words: tuple[str, ...], said: str, tmp_path: Path) -> None:
    done = command(tmp_path, *words)
    assert done.returncode == 2, done.stderr
    line = done.stderr.splitlines()[-1]
    assert said in line
    assert "Traceback" not in done.stderr
