"""Runs side by side."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from gr_ros2.report.compare import compare_grid, write_comparison
from gr_ros2.report.page import Run
from tests.record.runs import make_run


def _two(tmp_path: Path) -> list[Run]:
    one, other = make_run(tmp_path / "a", "one"), make_run(tmp_path / "b", "two")
    odom, _ = other.result.topics
    quick = replace(other.result, topics=(replace(odom, delivered=39, pdr=0.975),), phy={"name": "direct"})
    return [one, replace(other, result=quick)]


def test_a_column_per_run_and_a_dash_where_one_has_nothing(tmp_path: Path) -> None:
    grid = compare_grid(_two(tmp_path))
    assert grid.headings == ("Topic", "Number", "one", "two")
    odom, imu, link = ({line[1]: line[2:] for line in section} for section in grid.sections)
    assert odom["PDR"] == ("0.625", "0.975")
    assert odom["latency p50 [ms]"] == ("70.0", "70.0")
    assert odom["lost fragments"] == ("8", "8")
    assert imu["sent"] == ("9", "–")
    assert "path error [m]" not in imu
    assert link["airtime of a packet [ms]"] == ("10.0", "–")
    assert link["packets sent"] == ("74", "74")


def test_the_page_and_its_figures_are_written(tmp_path: Path) -> None:
    page, *others = write_comparison(_two(tmp_path), tmp_path / "out")
    assert page == tmp_path / "out" / "compare.html"
    text = page.read_text()
    assert text.count("data:image/") == 4
    assert "one · two" in text
    names = {path.name for path in others}
    assert names == {
        *(f"{name}.{kind}" for name in ("latency", "ledger", "delivery", "age") for kind in ("png", "svg")),
        *("summary.csv", "summary.parquet"),
    }
