"""Rows, intervals, axes and pictures of a sweep whose results are made by hand."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pyarrow.csv as pa_csv
import pyarrow.parquet as pa_parquet
import pytest

from gr_ros2.observe.result import AgeResult, LatencyResult, TopicResult
from gr_ros2_lab.record.result import ReceiverResult, Result
from gr_ros2_lab.record.statistics import share
from gr_ros2_lab.study.sweep.axes import Axes, choose_axes, curve_panels, heat_panels
from gr_ros2_lab.study.sweep.definition import SweepPlan
from gr_ros2_lab.study.sweep.figures import MOST_PANELS, curves_figure, heat_figure
from gr_ros2_lab.study.sweep.summaries import ALL, rows_of, summaries
from gr_ros2_lab.study.sweep.sweep_page import summary_grid, write_sweep
from tests.lab.study.sweeps import plan

ODOM, IMU = "/robot_1/odom", "/robot_1/imu"


def topic(name: str, sent: int, delivered: int, p50: float | None) -> TopicResult:
    return TopicResult(
        topic=name,
        type="nav_msgs/msg/Odometry",
        src_id=1,
        sent=sent,
        delivered=delivered,
        pdr=delivered / sent,
        goodput_Bps=10.0 * delivered,
        latency_s=LatencyResult(p50=p50),
        latency_clock="submit",
        age_s=AgeResult(),
        path_error_m=None,
        ledger={"delivered": delivered, "lost_fragments": sent - delivered},
    )


def result(*topics: TopicResult) -> Result:
    phy = {"name": "direct", "sample_rate": None, "airtime_s": None}
    return Result("made", 0, 1.0, {}, topics, {"sent": 7, "received": 5}, phy, wall_s=2.0)


def results(made: SweepPlan, *topics: TopicResult) -> dict[tuple[int, int], Result]:
    return {(cell.number, n): result(*topics) for cell in made.cells for n in range(len(cell.runs))}


def test_a_row_per_run_and_topic_and_one_for_all(tmp_path: Path) -> None:
    made = plan(tmp_path)
    found = rows_of(made, {(2, 1): result(topic(ODOM, 10, 5, 0.1), topic(IMU, 30, 30, 0.2))})
    assert [(row["topic"], row["sent"], row["delivered"], row["pdr"]) for row in found] == [
        (ALL, 40, 35, 0.875),
        (ODOM, 10, 5, 0.5),
        (IMU, 30, 30, 1.0),
    ]
    for row in found:
        assert (row["channel.packet_loss"], row["cell"], row["repetition"], row["seed"]) == (0.01, 2, 1, 1)
        assert (row["packets_sent"], row["packets_received"], row["wall_s"]) == (7, 5, 2.0)
    assert (found[0]["goodput_Bps"], found[0].get("latency_p50_s"), found[1]["latency_p50_s"]) == (350.0, None, 0.1)
    assert [row["ledger_lost_fragments"] for row in found] == [5, 5, 0]


def test_every_receiver_counts(tmp_path: Path) -> None:
    made = plan(tmp_path)
    first = result(topic(ODOM, 10, 5, 0.1), topic(IMU, 30, 30, 0.2))
    second = ReceiverResult(2, (topic(ODOM, 10, 9, 0.3),), packets={"sent": 7, "received": 6})
    found = rows_of(made, {(1, 0): replace(first, receivers=(second,))})
    assert [(row["topic"], row["sent"], row["delivered"], row["pdr"]) for row in found] == [
        (ALL, 50, 44, 0.88),
        (ODOM, 20, 14, 0.7),
        (IMU, 30, 30, 1.0),
    ]
    assert found[1]["latency_p50_s"] == pytest.approx(0.2)
    assert (found[1]["goodput_Bps"], found[1]["ledger_lost_fragments"]) == (140.0, 6)
    assert (found[0]["packets_sent"], found[0]["packets_received"]) == (14, 11)


def test_topics_without_the_number_that_is_shown_have_no_lines(tmp_path: Path) -> None:
    made = plan(tmp_path)
    found = summaries(made, rows_of(made, {(1, 0): result(topic(ODOM, 10, 5, 0.1), topic(IMU, 30, 30, 0.2))}))
    assert len(summary_grid(made, found, ("pdr",)).sections[0]) == 3
    grid = summary_grid(made, found, ("formation_error_m",))
    assert [len(section) for section in grid.sections] == [1]
    assert "topic" not in grid.headings


def test_repetitions_are_pooled_for_the_pdr_and_averaged_for_the_rest(tmp_path: Path) -> None:
    made = plan(tmp_path)
    runs = {(1, 0): result(topic(ODOM, 10, 5, 0.1)), (1, 1): result(topic(ODOM, 30, 30, 0.3))}
    all_topics, odom = summaries(made, rows_of(made, runs))
    assert (all_topics.topic, odom.topic, odom.runs, odom.sent, odom.delivered) == (ALL, ODOM, 2, 40, 35)
    assert odom.numbers["pdr"] == share(35, 40)
    latency = odom.numbers["latency_p50_s"]
    assert latency is not None and latency.value == pytest.approx(0.2)
    assert latency.high == pytest.approx(0.2 + 12.706 * 0.1, rel=1e-3)
    assert all_topics.numbers["latency_p50_s"] == latency  # with one topic, it is the link
    assert odom.numbers["age_mean_s"] is None


def test_the_files_of_a_sweep(tmp_path: Path) -> None:
    made = plan(tmp_path, grid={"channel.packet_loss": [0, 0.1], "packet_len": [64, 128]})
    folder = tmp_path / "channel.packet_loss=7"  # a folder that a Parquet data set would take for a column
    page, *others = write_sweep(made, results(made, topic(ODOM, 10, 5, 0.1)), ["cell 9: it <broke>"], folder)
    kinds = {"sweep": ("html", "parquet", "csv"), "cells": ("parquet", "csv")}
    kinds |= dict.fromkeys(("curves", "heatmap"), ("png", "svg"))
    assert {path.name for path in (page, *others)} == {f"{name}.{end}" for name in kinds for end in kinds[name]}
    table = pa_parquet.ParquetFile(folder / "sweep.parquet").read()
    assert table.num_rows == 2 * 2 * 2 * 2
    assert table["channel.packet_loss"].to_pylist()[:9] == [0.0] * 8 + [0.1]
    assert set(table["packet_len"].to_pylist()) == {64, 128}
    assert pa_csv.read_csv(folder / "sweep.csv").num_rows == table.num_rows
    cells = pa_parquet.ParquetFile(folder / "cells.parquet").read()
    assert cells.num_rows == 4 * 2
    bounds = share(10, 20)
    assert bounds is not None
    assert (cells["pdr_low"][0].as_py(), cells["pdr_high"][0].as_py()) == (bounds.low, bounds.high)
    text = page.read_text()
    assert "failed: cell 9: it &lt;broke&gt;" in text
    assert "0.500 [0.299, 0.701]" in text
    assert text.count("data:image/svg+xml") == 2


@pytest.mark.parametrize(
    ("changes", "axes"),
    [
        ({"grid": {"channel.packet_loss": [0, 0.1]}}, Axes("channel.packet_loss", (), None)),
        (
            {"grid": {"packet_len": [64, 128], "channel.snr_db": [1, 2]}, "set": {"phy.name": "gfsk"}},
            Axes("channel.snr_db", ("packet_len",), "packet_len"),
        ),
        (
            {"grid": {"phy.name": ["gfsk", "psk"], "channel.snr_db": [1, 2]}},
            Axes("channel.snr_db", ("phy.name",), None),
        ),
        (
            {"grid": {"phy.name": ["gfsk", "psk"], "channel.snr_db": [1, 2], "packet_len": [64, 128]}},
            Axes("channel.snr_db", ("phy.name",), "packet_len"),
        ),
        (
            {"grid": {"phy.name": ["gfsk", "psk"], "channel.snr_db": [1, 2], "packet_len": [64, 128]}}
            | {"x": "packet_len", "y": "phy.name", "by": "channel.snr_db"},
            Axes("packet_len", ("channel.snr_db",), "phy.name"),
        ),
        ({"grid": {"channel.snr_db": [None, 1]}, "set": {"phy.name": "gfsk"}}, Axes("channel.snr_db", (), None)),
        ({"grid": {"phy.name": ["direct", "gfsk"]}}, Axes("phy.name", (), None)),
    ],
)
def test_axes_suggested_by_the_keys(tmp_path: Path, changes: dict[str, Any], axes: Axes) -> None:
    fixed = {"phy.sample_rate": 1e5, **changes.pop("set", {})}
    assert choose_axes(plan(tmp_path, repetitions=1, set=fixed, **changes)) == axes


def test_what_is_on_no_axis_has_a_panel_of_its_own(tmp_path: Path) -> None:
    grid = {"channel.packet_loss": [0.1, 0], "paper.entry_ids": ["sequential", "random"], "packet_len": [64, 128]}
    made = plan(tmp_path, grid=grid)
    found = summaries(made, rows_of(made, results(made, topic(ODOM, 10, 5, 0.1))))
    axes = choose_axes(made)
    assert axes == Axes("channel.packet_loss", ("paper.entry_ids",), "packet_len")
    panels = curve_panels(made, axes, found)
    assert [panel.title for panel in panels] == ["packet length [B]=64", "packet length [B]=128"]
    assert list(panels[0].curves) == ["sequential", "random"]
    assert panels[0].curves["sequential"] == [(0.0, share(10, 20)), (0.1, share(10, 20))]
    heat = heat_panels(made, axes, found)
    assert [title for title, _ in heat] == ["sequential", "random"]
    assert heat[0][1] == {(loss, length): 0.5 for loss in (0.0, 0.1) for length in (64, 128)}


def test_figures_say_what_they_leave_out(tmp_path: Path) -> None:
    lengths = list(range(64, 64 + MOST_PANELS + 3))
    made = plan(
        tmp_path,
        grid={"channel.packet_loss": [0, 0.1], "debug": [False, True], "packet_len": lengths},
    )
    found = summaries(made, rows_of(made, results(made, topic(ODOM, 10, 5, 0.1))))
    figure, left_out = curves_figure(made, found)
    assert (len(figure.axes), left_out) == (MOST_PANELS, 3)
    assert figure.axes[0].get_xlabel() == "packet loss"
    assert [text.get_text() for text in figure.axes[0].get_legend().get_texts()] == [
        "debug=false",
        "debug=true",
    ]
    drawn = heat_figure(made, found)
    assert drawn is not None and drawn[1] == 0
    assert drawn[0].axes[0].get_ylabel() == "packet length [B]"


def test_another_number_of_one_topic(tmp_path: Path) -> None:
    made = plan(tmp_path, set={"registry": "table4", "duration_s": 1}, value="latency_p50_s", topic="/robot_1/imu")
    found = summaries(made, rows_of(made, results(made, topic(ODOM, 10, 5, 0.1), topic(IMU, 10, 5, 0.4))))
    figure, _ = curves_figure(made, found)
    (panel,) = figure.axes
    assert panel.get_ylabel() == "latency p50 [s] of /robot_1/imu"
    assert list(panel.lines[0].get_ydata()) == [0.4, 0.4, 0.4]
