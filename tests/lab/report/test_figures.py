"""The paper's figures 6 and 7."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

from gr_ros2.core.errors import ConfigError
from gr_ros2_lab.report.figures import SENT_EVERY, latency_figure, ledger_figure, path_figure, save_figure

ANGLE = np.linspace(0, 6, 501)
PATH = np.column_stack([np.cos(ANGLE), np.sin(ANGLE)])


def test_marks_stand_at_every_50th_message_sent_and_every_one_received() -> None:
    axes = path_figure(PATH, PATH[::20], "/robot_1/odom", "/rx_robot_1/odom").axes[0]
    lengths = [len(np.asarray(line.get_xdata())) for line in axes.lines]
    assert lengths == [501, 26, 26, 501 // SENT_EVERY + 1]
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("x [m]", "y [m]")


def test_a_latency_curve_rises_to_one() -> None:
    axes = latency_figure({"odom": [0.2, 0.1, 0.3], "none": []}).axes[0]
    (line,) = axes.lines
    assert list(np.asarray(line.get_xdata())) == pytest.approx([100, 200, 300])
    assert list(np.asarray(line.get_ydata())) == pytest.approx([0, 0.5, 1])
    assert axes.get_xlabel() == "latency [ms]"


@pytest.mark.parametrize("curves", [{}, {"a": []}, {"a": [0.1]}, {"a": [0.0, 0.1]}, {"a": [-0.1]}, {"a": [1e-4, 9.0]}])
def test_any_curves_can_be_drawn(tmp_path: Path, curves: dict[str, list[float]]) -> None:
    written = save_figure(latency_figure(curves), tmp_path, "latency")
    assert [path.stat().st_size > 0 for path in written] == [True] * 2


def test_files_are_png_and_svg(tmp_path: Path) -> None:
    png, svg = save_figure(path_figure([], [[1.0, 2.0]], "a", "b"), tmp_path / "new", "path")
    assert png.read_bytes().startswith(b"\x89PNG")
    assert "<svg" in svg.read_text()


def test_a_png_is_left_out_where_a_small_svg_is_enough(tmp_path: Path) -> None:
    for largest, suffixes in ((10**6, [".svg"]), (1000, [".png", ".svg"])):
        written = save_figure(path_figure(PATH, PATH, "a", "b"), tmp_path / str(largest), "path", largest)
        assert [path.suffix for path in written] == suffixes
        assert sorted((tmp_path / str(largest)).iterdir()) == written


def test_the_layout_is_the_one_that_matplotlib_computes(tmp_path: Path) -> None:
    own, other = (path_figure(PATH, PATH[::20], "a", "b") for _ in range(2))
    png, _ = save_figure(own, tmp_path, "path")
    other.savefig(tmp_path / "expected.png", dpi=150)
    assert (imread(png) == imread(tmp_path / "expected.png")).all()


def test_pyplot_is_not_touched(tmp_path: Path) -> None:
    code = (
        "import sys; from pathlib import Path; from gr_ros2_lab.report.figures import latency_figure, save_figure; "
        "save_figure(latency_figure({'a': [0.1]}), Path(sys.argv[1]), 'latency'); "
        "sys.exit('matplotlib.pyplot' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code, str(tmp_path)], check=False).returncode == 0


def test_a_place_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match="cannot be written"):
        save_figure(latency_figure({}), tmp_path / "file", "latency")


def test_ledger_bars_fill_the_width() -> None:
    ledgers = {"a": {"delivered": 9, "lost_fragments": 1}, "b": {"in_flight": 5, "new_fate": 5}, "c": {}}
    axes = ledger_figure(ledgers).axes[0]
    assert [label.get_text() for label in axes.get_yticklabels()] == ["a (10)", "b (10)"]
    widths = np.array([[bar.get_width() for bar in bars] for bars in axes.containers])
    assert widths.sum(axis=0) == pytest.approx([100, 100])
    assert [bars.get_label() for bars in axes.containers] == ["delivered", "lost fragments", "new fate", "in flight"]
    assert {"9", "1", "5"} <= {text.get_text() for text in axes.texts}


def test_no_ledger_can_be_drawn(tmp_path: Path) -> None:
    written = save_figure(ledger_figure({"a": {}}), tmp_path, "ledger")
    assert [path.stat().st_size > 0 for path in written] == [True] * 2
