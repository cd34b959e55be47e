"""The command: what it lists, how quickly, and how it fails."""

from __future__ import annotations

import re
import subprocess
import sys

import click
import pytest

from gr_ros2 import __version__
from gr_ros2.cli import main as command
from gr_ros2.core.errors import BackendMissingError, BagError, ConfigError, CrcError, GrRos2Error, PhyError, RunError


@pytest.mark.parametrize("arguments", [["--help"], ["-h"], []])
def test_help_lists_every_command(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert command.run(arguments) == 0
    out = capsys.readouterr().out
    assert [name for name in command.COMMANDS if f"  {name}" not in out] == []


@pytest.mark.parametrize("table", [command.COMMANDS, command.PACKET_COMMANDS, command.REGISTRY_COMMANDS])
def test_every_command_has_help(table: command.Commands) -> None:
    group = command.LazyGroup(table, "group", "")
    for name in group.list_commands(click.Context(group)):
        found = group.get_command(click.Context(group), name)
        assert found is not None
        assert found.get_help(click.Context(found))


def test_no_number_of_a_command_is_nan() -> None:
    asked = 0
    for table in (command.COMMANDS, command.PACKET_COMMANDS, command.REGISTRY_COMMANDS):
        group = command.LazyGroup(table, "group", "")
        for name in group.list_commands(click.Context(group)):
            found = group.get_command(click.Context(group), name)
            assert found is not None
            numbers = [one for one in found.params if isinstance(one.type, type(click.FLOAT))]
            asked += len(numbers)
            for one in numbers:
                for text in ("nan", "inf"):
                    with pytest.raises(click.BadParameter):
                        one.type.convert(text, one, None)
    assert asked > 15


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert command.run(["--version"]) == 0
    assert __version__ in capsys.readouterr().out


def test_help_imports_nothing_heavy() -> None:
    code = (
        "import sys; from gr_ros2.cli.main import run; run(['--help']);"
        "heavy = {'gnuradio', 'cyclonedds', 'rclpy', 'numpy', 'matplotlib', 'pydantic', 'rosbags'} & set(sys.modules);"
        "assert not heavy, heavy"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["nonsense"], "No such command 'nonsense'; see gr-ros2 --help"),
        (["packet", "nonsense"], "No such command 'nonsense'; see gr-ros2 packet --help"),
        (["packet", "decode", "--packet-len", "3", "00"], "'--packet-len': 3 is not in the range"),
        (["registry", "check"], "Missing argument 'FILE'; see gr-ros2 registry check --help"),
        (["scenarios", "--nonsense"], "No such option: --nonsense"),
    ],
)
def test_bad_usage_is_one_line_and_status_2(
    arguments: list[str], says: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command.run(arguments) == 2
    error = capsys.readouterr().err
    assert error.startswith("gr-ros2: ")
    assert says in error
    assert error.count("\n") == 1


@pytest.mark.parametrize(
    ("error", "status"),
    [
        (ConfigError("wrong"), 2),
        (CrcError("wrong"), 2),
        (BagError("wrong"), 2),
        (BackendMissingError("wrong"), 2),
        (RunError("wrong"), 1),
        (PhyError("wrong"), 1),
        (GrRos2Error("wrong\nover two lines"), 1),
        (KeyboardInterrupt(), 130),
        (BrokenPipeError(), 0),
    ],
)
def test_errors_end_in_a_status(
    error: BaseException, status: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    @click.command()
    def fails() -> None:
        raise error

    monkeypatch.setattr(sys, "stdout", sys.stdout)  # the broken pipe replaces it
    monkeypatch.setattr(command.LazyGroup, "get_command", lambda *_: fails)
    assert command.run(["fails"]) == status
    lines = capsys.readouterr().err.splitlines()
    assert ["gr-ros2: " in line for line in lines if line] == [True] * (status != 0)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ("--set robots={}", "robots = 'x...x': must be a list (the robots, those that send first"),
        ("--set {}", "gr-ros2: --set x...x: write key=value"),
        ("--set channel.{}=1", "gr-ros2: demo: unknown key channel.x...x; known are "),
        ("--set registry={}", "gr-ros2: x...x: File name too long"),
        ("--{}", "x...x; see gr-ros2 run --help"),
    ],
)
def test_a_long_value_is_shown_without_its_middle(words: str, says: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert command.run(["run", "demo", *words.format("x" * 20_000).split()]) != 0
    said = capsys.readouterr().err
    assert says in re.sub("x+", "x", said)
    assert len(said) < 1300


def test_the_program_exits_with_the_status() -> None:
    assert subprocess.run([sys.executable, "-m", "gr_ros2.cli", "nonsense"], capture_output=True).returncode == 2


def test_a_reader_that_goes_away_is_no_error() -> None:
    shell = f"set -o pipefail; yes 00 | head -20000 | {sys.executable} -m gr_ros2.cli packet decode - | head -1"
    done = subprocess.run(["bash", "-c", shell], capture_output=True, text=True)
    assert done.stderr == ""
    assert done.stdout.startswith("packet 1: rejected: length")
