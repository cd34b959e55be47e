"""A robot without the packages that experiments, reports and the dashboard need: its commands work, others say what is
missing.
"""

from __future__ import annotations

import re
import subprocess
import sys

import pytest

from tests.domains import free_ports
from tests.packages import REPOSITORY

LABORATORY = ("gr_ros2_lab", "matplotlib", "plotext", "pyarrow", "jinja2", "bokeh", "tornado", "distributed", "dask")
_BLOCKED = f"""
import sys

class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {LABORATORY!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, Blocked())
from gr_ros2.cli.main import run
sys.exit(run(sys.argv[1:]))
"""


def on_a_robot(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", _BLOCKED, *arguments], capture_output=True, text=True)


def test_what_a_robot_installs_has_none_of_them() -> None:
    required = re.search(r"install_requires=\[(.*?)\]", (REPOSITORY / "setup.py").read_text("utf-8"), re.S)
    assert required is not None
    assert [name for name in LABORATORY if f'"{name}' in required[1]] == []


@pytest.mark.slow
def test_a_link_runs_without_them() -> None:
    pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")
    own, other = free_ports(2)
    done = on_a_robot(
        *("link", "--robot", "1", "--radio", "udp", "--listen", f"127.0.0.1:{own}", "--peer", f"127.0.0.1:{other}"),
        *("--set", "graph.middleware=memory", "--duration", "1"),
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("words", [("link", "--help"), ("status", "--help"), ("doctor", "--help"), ("--help",)])
def test_commands_of_a_robot_start_without_them(words: tuple[str, ...]) -> None:
    done = on_a_robot(*words)
    assert done.returncode == 0 and done.stdout, done.stderr


@pytest.mark.parametrize("words", [("run", "demo"), ("report", "nowhere"), ("medium", "m.yaml"), ("scenarios",)])
def test_a_command_of_the_laboratory_says_what_to_install(words: tuple[str, ...]) -> None:
    done = on_a_robot(*words)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert line.startswith("gr-ros2: this needs gr_ros2_lab") and line.endswith("pip install 'gr-ros2[lab]'")
