"""`gr-ros2 report` and `gr-ros2 compare`."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from gr_ros2.cli import main as command
from tests.lab.record.runs import make_run


@pytest.mark.usefixtures("undrawn")
def test_one_folder_gets_its_own_report(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    make_run(tmp_path)
    assert command.run(["report", str(tmp_path)]) == 0
    assert (tmp_path / "report.html").is_file()
    assert f"Written: {tmp_path / 'report.html'}" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_several_folders_leave_theirs_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    make_run(tmp_path / "a", "one")
    make_run(tmp_path / "b", "two")
    before = sorted(tmp_path.rglob("*"))
    monkeypatch.chdir(tmp_path)
    assert command.run(["report", "a", "b"]) == 0
    assert len(list(tmp_path.glob("results/report-*/report.html"))) == 1
    assert command.run(["compare", "a", "b", "--out", "c"]) == 0
    assert (tmp_path / "c" / "compare.html").is_file()
    new = {path.relative_to(tmp_path).parts[0] for path in set(tmp_path.rglob("*")) - set(before)}
    assert new == {"results", "c"}
    out = capsys.readouterr().out
    assert "Nothing differs" in out


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:100])


def other_topics(path: Path) -> None:
    path.write_text(path.read_text().replace("/robot_1/imu", "/robot_1/fix"))


DAMAGES: dict[str, tuple[str, Callable[[Path], object], str]] = {
    "a table half-written": ("messages.parquet", cut, "damaged or half-written"),
    "a table missing": ("packets.parquet", Path.unlink, "cannot be read (no such file); run the experiment again"),
    "a table of something else": ("paths.parquet", lambda path: path.write_bytes(b"text"), "damaged or half-written"),
    "a result half-written": ("result.json", cut, "damaged or half-written, no JSON"),
    "a result missing": ("result.json", Path.unlink, "no such file; give the folder of a run"),
    "a result empty": ("result.json", lambda path: path.write_text(""), "damaged or half-written, no JSON"),
    "no result": ("result.json", lambda path: path.write_text("{}"), "no result of an experiment"),
    "a result of another run": ("result.json", other_topics, "not of the same run"),
    "a list of repetitions half-written": (
        "repetitions.json",
        lambda path: path.write_text("{"),
        "damaged or half-written",
    ),
}


@pytest.mark.parametrize("damage", DAMAGES)
@pytest.mark.parametrize("name", ["report", "compare"])
def test_a_damaged_folder_is_one_line_and_status_2(
    tmp_path: Path, name: str, damage: str, capsys: pytest.CaptureFixture[str]
) -> None:
    make_run(tmp_path / "a", "one")
    make_run(tmp_path / "b", "two")
    file, do_it, says = DAMAGES[damage]
    do_it(tmp_path / "b" / file)
    assert command.run([name, str(tmp_path / "a"), str(tmp_path / "b")]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"gr-ros2: {tmp_path / 'b'}/")
    assert says in error
    assert error.count("\n") == 1


@pytest.mark.parametrize("name", ["report", "compare"])
def test_a_missing_folder_is_one_line_and_status_2(
    tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    make_run(tmp_path / "a", "one")
    assert command.run([name, str(tmp_path / "a"), str(tmp_path / "nowhere")]) == 2
    assert "nowhere: no such folder; give the folder of a run" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_repetitions_are_reported_together(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for k in range(2):
        make_run(tmp_path / f"rep-{k}", "one")
    (tmp_path / "repetitions.json").write_text('{"seeds": [3, 4]}')
    assert command.run(["report", str(tmp_path)]) == 0
    page = (tmp_path / "report.html").read_text()
    assert all(f"rep-{k}" in page for k in range(2))
    assert command.run(["compare", str(tmp_path), "--out", str(tmp_path / "c")]) == 0
    assert "rep-1" in capsys.readouterr().out


def test_one_run_has_nothing_to_be_compared_with(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    make_run(tmp_path)
    assert command.run(["compare", str(tmp_path)]) == 2
    assert "give two folders or more" in capsys.readouterr().err


def test_reports_need_no_radio_and_no_ros(tmp_path: Path) -> None:
    make_run(tmp_path)
    code = (
        f"import sys; from gr_ros2.cli.main import run; assert run(['report', {str(tmp_path)!r}]) == 0;"
        "heavy = {'gnuradio', 'cyclonedds', 'rclpy', 'matplotlib.pyplot', 'pandas'} & set(sys.modules);"
        "assert not heavy, heavy"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
