"""Shells complete what the command offers: asked as bash asks, through the script we print."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from gr_ros2.cli.completion import SHELLS
from gr_ros2.cli.main import COMMANDS, run
from gr_ros2.cli.params import setting_keys
from gr_ros2_lab.run.scenario import Scenario, dump, load_scenario


@pytest.mark.parametrize("shell", SHELLS)
def test_the_script_is_one_that_the_shell_reads(shell: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["completion", shell]) == 0
    script = capsys.readouterr().out
    assert "_GR_ROS2_COMPLETE" in script
    if shutil.which(shell) is None:
        pytest.skip(f"{shell} is not installed")
    file = tmp_path / "script"
    file.write_text(script)
    subprocess.run([shell, "-n", str(file)], check=True)


def completions(words: list[str], tmp_path: Path) -> list[str]:
    """What bash offers for a command line whose last word is being typed, with our script in a file."""
    program = tmp_path / "gr-ros2"
    program.write_text(f'#!/bin/sh\nexec {sys.executable} -m gr_ros2.cli "$@"\n')
    program.chmod(0o755)
    line = " ".join(words)
    script = (
        f'source {tmp_path}/script 2>/dev/null; COMP_WORDS=({line}); [ "{words[-1]}" ] || COMP_WORDS+=("");'
        f"COMP_CWORD={len(words) - 1}; _gr_ros2_completion gr-ros2; printf '%s\\n' \"${{COMPREPLY[@]}}\""
    )
    environ = {**os.environ, "PATH": f"{tmp_path}:{os.environ['PATH']}"}
    done = subprocess.run(["bash", "-c", script], env=environ, capture_output=True, text=True, check=True)
    return done.stdout.split()


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("bash") is None, reason="bash is missing")
def test_bash_completes_commands_scenarios_and_options(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["completion", "bash"]) == 0
    (tmp_path / "script").write_text(capsys.readouterr().out)
    assert completions(["gr-ros2", "re"], tmp_path) == [name for name in COMMANDS if name.startswith("re")]
    offered = completions(["gr-ros2", "run", "paper-"], tmp_path)
    assert {"paper-direct", "paper-ofdm"} <= set(offered)
    assert "--duration" in completions(["gr-ros2", "run", "--du"], tmp_path)
    assert completions(["gr-ros2", "run", "demo", "--set", "phy.sam"], tmp_path) == ["phy.sample_rate"]


def test_the_settings_offered_are_there() -> None:
    keys = list(setting_keys(Scenario))
    assert {"packet_len", "graph.domain_id", "phy.options", "paths"} <= set(keys)
    for key in keys:
        value = dump(load_scenario("two-way"))
        for name in key.split("."):
            assert name in value, key
            value = value[name]
