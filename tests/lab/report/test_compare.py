"""Runs side by side."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from gr_ros2_lab.record.result import LatenessResult
from gr_ros2_lab.record.team_numbers import team_numbers
from gr_ros2_lab.report.compare import compare_grid, lateness_of, write_comparison
from gr_ros2_lab.report.page import Run
from gr_ros2_lab.run.runner import run_scenario
from gr_ros2_lab.run.scenario import load_scenario
from tests.lab.record.runs import make_run


def _two(tmp_path: Path) -> list[Run]:
    one, other = make_run(tmp_path / "a", "one"), make_run(tmp_path / "b", "two")
    odom, _ = other.result.topics
    quick = replace(other.result, topics=(replace(odom, delivered=39, pdr=0.975),), phy={"name": "direct"})
    return [one, replace(other, result=quick)]


def test_a_column_per_run_and_a_dash_where_one_has_nothing(tmp_path: Path) -> None:
    grid = compare_grid(_two(tmp_path))
    assert grid.headings == ("", "", "one", "two")
    odom, imu, link = ({line[1]: line[2:] for line in section} for section in grid.sections)
    assert odom["PDR"] == ("0.625", "0.975")
    assert not {"latency p50 [ms]", "lost fragments"} & odom.keys(), "they are equal"
    assert imu["sent"] == ("9", "–")
    assert "path error [m]" not in imu
    assert link["airtime of a packet [ms]"] == ("10.0", "–")
    assert "packets sent" not in link


def test_of_teams_all_robots_are_compared_and_the_title_says_whose_the_topics_are() -> None:
    runs = [
        Run(Path(access), access, ran.result, ran.trace)
        for access in ("slots", "aloha")
        for ran in [run_scenario(load_scenario("team", [f"medium={access}"], duration_s=2.0))]
    ]
    grid = compare_grid(runs)
    assert grid.title == "What differs; topics and link as /robot_1 receives it"
    told = {line[1]: line[2:] for section in grid.sections for line in section if line[0] == "all robots"}
    pdrs = [team_numbers(run.result)["pair_pdr"] for run in runs]
    assert told["PDR over all pairs"] == tuple(f"{pdr:.3g}" for pdr in pdrs)
    assert "time to meet [s]" not in told


def test_the_page_and_its_figures_are_written(tmp_path: Path) -> None:
    page, *others = write_comparison(_two(tmp_path), tmp_path / "out", pictures=True)
    assert page == tmp_path / "out" / "compare.html"
    text = page.read_text()
    assert text.count("data:image/") == 4
    assert "one · two" in text
    names = {path.name for path in others}
    assert names == {
        *(f"{name}.{kind}" for name in ("latency", "ledger", "delivery", "age") for kind in ("png", "svg")),
        *("summary.csv", "summary.parquet"),
    }


def test_settings_that_differ_stand_first(tmp_path: Path) -> None:
    one, other = make_run(tmp_path / "a", "one"), make_run(tmp_path / "b", "two")
    configs = [
        {"packet_len": size, "part": {"packet_len": size, "repair": "off"}, "channel": {"snr_db": snr_db}}
        for size, snr_db in ((64, 10), (220, 10))
    ]
    runs = [
        replace(run, result=replace(run.result, config=config))
        for run, config in zip((one, other), configs, strict=True)
    ]
    assert compare_grid(runs).sections == ((("setting", "packet_len", "64", "220"),),)
    assert compare_grid([one, one]).title == "Nothing differs"


def test_a_run_in_which_the_computer_was_late_is_named_first(tmp_path: Path) -> None:
    one, other = _two(tmp_path)
    late = replace(other, result=replace(other.result, lateness=LatenessResult({"gate": 0.4}, 9, 0.86, 1, 1, 9, 9)))
    assert lateness_of([one, other]) == []
    [line] = lateness_of([one, late])
    assert line.startswith("two: The computer did not keep up with the clock: 9 times")
    page, *_ = write_comparison([one, late], tmp_path / "out")
    assert page.read_text().index("did not keep up") < page.read_text().index("What differs")
