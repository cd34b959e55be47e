"""`sweep`: a list, one clear line for what is wrong, a table and files, and Ctrl-C at any time."""

from __future__ import annotations

import os
import signal
import subprocess
from pathlib import Path

import pyarrow.parquet as pa_parquet
import pytest

pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")
pytest.importorskip("distributed", reason="needs Dask: pip install 'gr-ros2[sweep]'")

from gr_ros2.cli.main import BAD_INPUT, FAILED, INTERRUPTED, run
from gr_ros2_lab.study.sweep.definition import builtin_sweeps
from tests.e2e.support import COMMAND
from tests.lab.study.sweeps import write_sweep_file
from tests.programs import ProgramProcess
from tests.waiting import PATIENCE_S, wait_for


def test_without_a_name_it_lists_the_built_in_sweeps(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["sweep"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == builtin_sweeps()
    assert all(len(line) < 120 and len(line.split()) > 3 for line in lines)


def test_what_is_wrong_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write_sweep_file(tmp_path, grid={"channel.packet_loss": [0, 1.5]})
    for words in (["nonsense"], [str(path)], [str(tmp_path / "nowhere.yaml")], ["pdr-vs-snr", "--workers", "0"]):
        assert run(["sweep", *words, "--out", str(tmp_path / "out")]) == BAD_INPUT
        assert len(capsys.readouterr().err.splitlines()) == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("words", [["sweep"], ["run"], ["race", "--duration"], ["compare"], ["report"], ["ablate"]])
def test_a_folder_that_cannot_be_written_is_named_before_all_else(
    words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "plain").write_text("")
    assert run([words[0], "--out", str(tmp_path / "plain" / "x"), *words[1:], "nonsense"]) == BAD_INPUT
    assert "plain/x: cannot be written (Not a directory); choose another folder" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.filterwarnings("error:constrained_layout not applied")  # by the long paths of the registries
def test_a_sweep_from_end_to_end_on_two_processes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("a", "b"):
        (tmp_path / f"{name}.csv").write_text("odom,nav_msgs/Odometry\n" + f"{name},std_msgs/String\n")
    path = write_sweep_file(tmp_path, grid={"channel.packet_loss": [0, 0.2], "registry": ["a.csv", "b.csv"]})
    monkeypatch.chdir(tmp_path)
    words = ["sweep", str(path), "--workers", "2", "--set", "packet_len=128"]
    assert run(words) == 0
    out = tmp_path / "results" / "sweep-lost"
    table = pa_parquet.ParquetFile(out / "sweep.parquet").read()
    assert set(table["channel.packet_loss"].to_pylist()) == {0.0, 0.2}
    said = capsys.readouterr().out
    assert "1.000 [0.9" in said
    assert "Written to results/sweep-lost: sweep.html, sweep.parquet, sweep.csv" in said
    assert (out / "curves.png").read_bytes().startswith(b"\x89PNG")

    (tmp_path / "a.csv").write_text("nothing of the kind")
    assert run(words) == BAD_INPUT
    assert "cell 1 of 4 (channel.packet_loss=0, registry=a.csv)" in capsys.readouterr().err


def test_failed_runs_are_told_and_are_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from gr_ros2_lab.study.sweep import run as running

    path = write_sweep_file(tmp_path)

    def without_registry(plan: object, *words: object, **options: object) -> object:
        monkeypatch.setattr("gr_ros2_lab.study.sweep.cluster._portable", lambda _: {"registry": "gone"})
        return run_sweep(plan, *words, **options)  # type: ignore[arg-type]

    run_sweep = running.run_sweep
    monkeypatch.setattr(running, "run_sweep", without_registry)
    assert run(["sweep", str(path), "--out", str(tmp_path / "out"), "--workers", "1"]) == FAILED
    captured = capsys.readouterr()
    assert captured.out.count("failed: cell ") == 6
    assert "repetition 1: registry = 'gone': no such file" in captured.out
    assert captured.err == "gr-ros2: lost: 6 of 6 runs failed; the same command tries them again\n"


@pytest.mark.slow
@pytest.mark.parametrize(("number", "workers"), [(signal.SIGINT, 2), (signal.SIGTERM, 1)])
def test_a_sweep_that_is_stopped_ends_and_can_be_continued(
    tmp_path: Path, number: signal.Signals, workers: int
) -> None:
    path, out = write_sweep_file(tmp_path, repetitions=60), tmp_path / "out"
    process = ProgramProcess(
        [*COMMAND, "sweep", str(path), "--out", str(out), "--workers", str(workers)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        wait_for(lambda: len(list(out.glob("runs/*.json"))) >= 3 or process.poll() is not None, "runs to end")
        if number == signal.SIGINT:
            os.killpg(process.pid, number)  # as a terminal does: the workers get it too
        else:
            process.send_signal(number)
        said, errors = process.communicate(timeout=PATIENCE_S)
    finally:
        process.kill()
    assert (process.returncode, errors) == (INTERRUPTED, "")
    kept = len(list(out.glob("runs/*.json")))
    assert f"stopped with {kept} of 180 runs kept in {out}; the same command goes on from there" in said


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_a_sweep_tabulates_repaired_messages_and_the_air(tmp_path: Path) -> None:
    fixed = {"robots": [{}, {"topics": []}], "duration_s": 4}
    path = write_sweep_file(
        tmp_path, scenario="paper-ofdm-paced", set=fixed, grid={"channel.packet_loss": [0.0, 0.2]}, repetitions=1
    )
    out = tmp_path / "out"
    assert run(["sweep", str(path), "--workers", "1", "--out", str(out)]) == 0
    table = pa_parquet.ParquetFile(out / "sweep.parquet").read().to_pylist()
    rows = [row for row in table if row["topic"] == "/robot_1/odom"]
    clean, lossy = sorted(rows, key=lambda row: row["channel.packet_loss"])
    assert clean["pdr"] == 1
    assert lossy["pdr"] >= 0.99
    assert clean["ledger_repaired"] == 0 < lossy["ledger_repaired"]
    assert clean["packets_air_repair"] == 0 < lossy["packets_air_repair"]
