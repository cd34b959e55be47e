"""Repetitions: other seeds each time, means with intervals, one report over all."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from gr_ros2.core.errors import ConfigError
from gr_ros2_lab.record.repetitions import REPETITIONS_FILE, run_folders, summarize
from gr_ros2_lab.record.result import Result
from gr_ros2_lab.report.page import read_runs
from gr_ros2_lab.report.repetitions import repetition_grid, repetition_summary
from gr_ros2_lab.run.runner import repetitions, run_repetitions
from gr_ros2_lab.run.scenario import Scenario, load_scenario

LOSSY = ["channel.packet_loss=0.02", "time=packets"]


def lossy(count: int, *changes: str) -> Scenario:
    return load_scenario("paper-direct", [*LOSSY, *changes], duration_s=2.0, repetitions=count, seed=5)


def test_every_seed_moves_on_with_the_repetition() -> None:
    two_way = load_scenario("two-way", ["channel.seed=50"], repetitions=3, seed=5)
    runs = list(repetitions(two_way))
    assert [run.seed for run in runs] == [run.sim.seed for run in runs] == [5, 6, 7]
    assert [run.channel.seed for run in runs] == [50, 51, 52]
    before = two_way.all_robots[1].paths[0].channel.seed
    assert [run.all_robots[1].paths[0].channel.seed - before for run in runs] == [0, 1, 2]
    assert {run.repetitions for run in runs} == {1}
    assert replace(runs[0], repetitions=3) == two_way


def test_runs_and_their_summary_are_written(tmp_path: Path) -> None:
    results = run_repetitions(lossy(3), tmp_path)
    assert [result.seed for result in results] == [5, 6, 7]
    values = json.loads((tmp_path / REPETITIONS_FILE).read_text())
    (odom,) = values["topics"]
    pdrs = [result.topics[0].pdr for result in results]
    assert values["seeds"] == [5, 6, 7]
    assert odom["pdr"]["runs"] == pdrs
    assert odom["pdr"]["mean"] == pytest.approx(sum(pdrs) / 3)  # type: ignore[arg-type]
    assert odom["pdr"]["low"] < odom["pdr"]["mean"] < odom["pdr"]["high"]
    assert len(set(pdrs)) > 1
    assert [run.label for run in read_runs([tmp_path])] == ["rep-0", "rep-1", "rep-2"]
    grid = repetition_grid(results)
    (section,) = grid.sections
    assert section[0][:3] == ("/robot_1/odom", "PDR", f"{odom['pdr']['mean']:.3f}")
    assert section[0][4:] == (f"{min(pdrs):.3f}", f"{max(pdrs):.3f}")  # type: ignore[type-var]


def test_the_same_again_gives_the_same_numbers(tmp_path: Path) -> None:
    first, again = (run_repetitions(lossy(2), tmp_path / name) for name in ("a", "b"))
    assert [result.topics for result in first] == [result.topics for result in again]


def test_a_run_that_is_there_is_not_overwritten(tmp_path: Path) -> None:
    run_repetitions(lossy(1), tmp_path)
    before = (tmp_path / "rep-0" / "result.json").read_bytes()
    with pytest.raises(ConfigError, match="holds a run already"):
        run_repetitions(lossy(2), tmp_path)
    assert (tmp_path / "rep-0" / "result.json").read_bytes() == before


def test_what_came_to_its_end_before_ctrl_c_is_kept(tmp_path: Path) -> None:
    starts = iter(range(10))

    def on_start() -> None:
        if next(starts) == 2:
            raise KeyboardInterrupt

    assert [result.seed for result in run_repetitions(lossy(5), tmp_path, on_start)] == [5, 6]
    assert [run.result.seed for run in read_runs([tmp_path])] == [5, 6]


def test_a_number_that_some_runs_do_not_have(result: Result) -> None:
    odom, imu = result.topics
    silent = replace(result, topics=(replace(odom, pdr=None),))
    first, second = summarize([result, silent])
    assert first.runs["pdr"] == [0.9, None]
    assert first.estimates["pdr"] is not None
    assert (first.estimates["pdr"].value, first.estimates["pdr"].low) == (0.9, None)
    assert second.topic == imu.topic
    assert second.runs["goodput_Bps"] == [0.0, None]
    assert second.estimates["latency_p50_s"] is None
    lines = [line for section in repetition_grid([result, silent]).sections for line in section]
    assert ("/robot_1/odom", "PDR", "0.900", "–", "0.900", "0.900") in lines
    assert not [line for line in lines if line[:2] == ("/robot_1/imu", "p50 [ms]")]


def test_several_runs_of_a_team_say_its_task_first_in_few_lines(result: Result) -> None:
    robots = [{"topics": {"auto": {}}, "direction": "both"}] * 3
    runs = [replace(result, task={"formation_error_m": error}, config={"robots": robots}) for error in (0.2, 0.4)]
    (lines,) = repetition_summary(runs).sections
    assert lines[0][0] == "formation error [m]"
    assert (lines[0][1], *lines[0][3:]) == ("0.3", "0.2", "0.4")
    assert len(lines) <= 10


def test_several_runs_with_many_topics_have_a_line_each(result: Result) -> None:
    many = tuple(replace(result.topics[0], topic=f"/robot_1/t{n}", pdr=n / 20) for n in range(12))
    (lines,) = repetition_summary([replace(result, topics=many)] * 2).sections
    assert [line[0] for line in lines] == [f"/robot_1/t{n}" for n in range(8)]
    assert lines[0][1] == "0.000 ± 0.000"


def test_a_damaged_list_of_repetitions_is_named(tmp_path: Path) -> None:
    assert run_folders(tmp_path) == [tmp_path]
    for damaged in ("", '{"seeds": [1', "[]", '{"seeds": 3}'):
        (tmp_path / REPETITIONS_FILE).write_text(damaged)
        with pytest.raises(ConfigError, match=r"repetitions\.json: damaged or half-written"):
            run_folders(tmp_path)
