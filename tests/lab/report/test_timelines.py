"""The pictures over time."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

from gr_ros2_lab.record.trace import Messages, Packets
from gr_ros2_lab.report.figures import save_figure
from gr_ros2_lab.report.timelines import (
    Deliveries,
    age_figure,
    airtime_figure,
    delivery_figure,
    nice_step,
    packets_figure,
)
from tests.lab.record.runs import AIRTIME_S, DURATION_S, empty_trace, make_run

NAN = float("nan")


def _messages(t_sent: list[float], t_delivered: list[float]) -> Messages:
    count = len(t_sent)
    fate = np.array(["x"] * count, dtype=object)
    serial = np.arange(count)
    return Messages("/t", 1, serial, np.array(t_sent), np.array(t_delivered), np.full(count, 500), fate)


def _line(figure: Figure, place: int, label: str) -> tuple[list[float], list[float]]:
    line = next(line for line in figure.axes[place].lines if line.get_label() == label)
    return np.asarray(line.get_xdata()).tolist(), np.asarray(line.get_ydata()).tolist()


def test_pdr_counts_at_submission_and_goodput_at_delivery() -> None:
    messages = _messages([0.05, 0.06, 0.15, 0.35], [0.25, NAN, 0.26, NAN])
    figure = delivery_figure({"a": Deliveries.of([messages])}, 4.0)
    x, y = _line(figure, 0, "a")
    assert x == pytest.approx([0.05, 0.15, 0.35])  # none was submitted in between
    assert y == pytest.approx([0.5, 1, 0])
    (goodput,) = (line for line in figure.axes[1].lines if len(np.asarray(line.get_xdata())) > 2)
    heights = np.asarray(goodput.get_ydata())
    assert heights[2] == pytest.approx(2 * 500 / 0.1 / 1000)
    assert np.count_nonzero(heights) == 1


def test_a_message_refused_at_once_counts_when_it_came() -> None:
    assert Deliveries.of([_messages([NAN, 1.0, NAN, 2.0], [NAN] * 4)]).t_sent.tolist() == [0, 1, 1, 2]


def test_topics_are_joined_in_the_order_of_submission() -> None:
    one, other = _messages([1.0], [2.0]), _messages([3.0, 4.0], [5.0, 6.0])
    assert sorted(Deliveries.of([one, other]).t_sent) == [1, 3, 4]
    assert len(Deliveries.of([]).t_sent) == 0


def test_age_is_a_sawtooth() -> None:
    figure = age_figure({"/t": {"run": _messages([0.0, 1.0, 2.0], [0.5, NAN, 3.0])}}, {"run": 4.0})
    t, age = _line(figure, 0, "run")
    assert t == pytest.approx([0.5, 3, 3, 4])
    assert age == pytest.approx([0.5, 3, 1, 2])


def test_runs_far_apart_share_a_logarithmic_axis() -> None:
    quick, slow = _messages([0.0, 1.0], [0.01, 1.01]), _messages([0.0], [50.0])
    assert age_figure({"/t": {"a": quick, "b": slow}}, {"a": 2, "b": 60}).axes[0].get_yscale() == "log"
    assert age_figure({"/t": {"a": quick, "b": quick}}, {"a": 2, "b": 2}).axes[0].get_yscale() == "linear"


def test_the_air_is_full_at_100_percent() -> None:
    count = 100
    t = np.arange(count) / 100
    packets = Packets(
        np.arange(count), t, np.where(t < 0.5, t, NAN), np.full(count, "/t"), *[np.ones(count, dtype=np.int64)] * 4
    )
    figure = airtime_figure(packets, airtime_s=0.01, duration_s=1.0)
    sent, received = (patch for patch in figure.axes[0].patches if str(patch.get_label()).startswith("packets"))
    assert np.nanmean(sent.get_data().values[:10]) == pytest.approx(100, rel=0.1)  # type: ignore[attr-defined]
    assert received.get_data().values[-1] == 0  # type: ignore[attr-defined]


def test_every_entry_of_the_first_packets_is_drawn(tmp_path: Path) -> None:
    packets = make_run(tmp_path).trace.packets()
    figure = packets_figure(packets, ["/robot_1/odom", "/robot_1/imu"])
    first = packets.t_sent < packets.t_sent[0] + 2
    blocks, _ = figure.axes[0].collections
    assert len(blocks.get_paths()) == first.sum()
    left = figure.axes[1].lines[0]
    assert len(np.asarray(left.get_xdata())) == len(np.unique(packets.packet[first]))
    legend = [text.get_text() for text in figure.legends[0].get_texts()]
    assert legend == ["/robot_1/odom", "/robot_1/imu", "left", "arrived", "did not arrive"]


def test_what_is_announced_before_the_run_is_not_among_the_first_packets(tmp_path: Path) -> None:
    packets = make_run(tmp_path).trace.packets()
    later = replace(packets, t_sent=np.where(packets.packet < 2, -2.0, packets.t_sent))
    (left, *_) = packets_figure(later, ["/robot_1/odom"]).axes[1].lines
    assert np.asarray(left.get_ydata()).min() >= 0
    assert len(np.asarray(left.get_xdata())) > 2


def test_nothing_can_be_drawn_too(tmp_path: Path) -> None:
    packets = empty_trace().packets()
    nothing = _messages([], [])
    for number, figure in enumerate(
        [
            packets_figure(packets, []),
            airtime_figure(packets, AIRTIME_S, 0.0),
            airtime_figure(packets, AIRTIME_S, DURATION_S),
            delivery_figure({}, 0.0),
            delivery_figure({"a": Deliveries.of([nothing])}, 1.0),
            delivery_figure({"a": Deliveries.of([_messages([1.0], [NAN])])}, 2.0),
            age_figure({}, {}),
            age_figure({"/t": {"run": _messages([1.0], [NAN])}}, {"run": 2.0}),
        ]
    ):
        written = save_figure(figure, tmp_path, f"figure{number}")
        assert [path.stat().st_size > 0 for path in written] == [True] * 2


@pytest.mark.parametrize(
    ("at_least", "step"), [(0.011, 0.02), (0.1, 0.1), (0.3, 0.5), (1, 1), (6, 10), (99, 100), (2.0000000001, 2)]
)
def test_steps_are_round(at_least: float, step: float) -> None:
    assert nice_step(at_least) == pytest.approx(step)
