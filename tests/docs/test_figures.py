"""The figures of pages are those of the commands that stand beside them."""

from __future__ import annotations

import importlib.util
import re
import subprocess
import sys
from importlib.machinery import SourceFileLoader
from pathlib import Path
from types import ModuleType

import pytest

pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")

from gr_ros2_lab.run.builtin import builtin_scenarios

ROOT = Path(__file__).parents[2]
TOOL = ROOT / "tools" / "measure-scenarios"


@pytest.fixture(scope="module")
def tool() -> ModuleType:
    loader = SourceFileLoader("measure_scenarios", str(TOOL))
    spec = importlib.util.spec_from_loader(loader.name, loader)
    assert spec is not None
    module = importlib.util.module_from_spec(spec)
    loader.exec_module(module)
    return module


def test_the_table_has_every_scenario_and_its_commands_are_runs(tool: ModuleType) -> None:
    commands = [row["command"] for row in tool.ROW.finditer(tool.PAGE.read_text("utf-8"))]
    assert len(commands) == len(set(commands))
    paper = {"paper-direct", "paper-ofdm"}  # their figures stand elsewhere
    assert {command.split()[0] for command in commands} == set(builtin_scenarios()) - paper
    for command in commands:
        assert tool.scenario_of(command).simulated


@pytest.mark.slow
def test_the_table_has_the_figures_of_its_commands() -> None:
    words = ("medium=slots", "channel-burst-loss", "channel-rayleigh", "`rtk`")
    done = subprocess.run([sys.executable, TOOL, "--check", *words], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


def test_figures_of_another_run_do_not_agree(tool: ModuleType) -> None:
    assert tool.agree("99.8% | 343 ms | 1.6 s", "98% | 0.33 s | 1.7 s")
    assert tool.agree("0% | – | –", "0% | – | –")
    for other in ("95% | 343 ms | 1.6 s", "99.8% | 440 ms | 1.6 s", "99.8% | 343 ms | 16 s", "99.8% | – | –"):
        assert not tool.agree("99.8% | 343 ms | 1.6 s", other)


def test_readme_and_measurements_say_the_same_of_the_papers_experiments() -> None:
    pages = [(ROOT / page).read_text("utf-8") for page in ("README.md", "docs/explanation/measurements.md")]
    readme, measured = (
        {
            name: re.findall(r"[\d,.]+", cells)
            for name, cells in re.findall(r"^\| `(?:gr-ros2 run )?(paper-ofdm(?:-paced)?)`.*?\| (.*) \|$", page, re.M)
        }
        for page in pages
    )
    assert readme.keys() == measured.keys() == {"paper-ofdm", "paper-ofdm-paced"}
    for name, (sent, received, p99) in readme.items():
        assert [sent, received] == measured[name][:2]
        assert p99 == measured[name][-1]
