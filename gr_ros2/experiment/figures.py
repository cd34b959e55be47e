"""The pictures of an experiment: the paper's figure 7 (paths) and figure 6 (latency), as PNG and SVG.

Law: figures are objects of their own; nothing of matplotlib's global state is read or changed, so they can be
drawn in any thread, with or without a display.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

from gr_ros2.errors import ConfigError

SENT_EVERY = 50
"""The paper marks every 50th transmitted message."""

_SENT, _RECEIVED = "#1f5fbf", "#d62728"


def path_figure(sent: npt.ArrayLike, received: npt.ArrayLike, sent_name: str, received_name: str) -> Figure:
    """Figure 7: the transmitted path in blue with a mark every 50 messages, the received one in red with a mark at
    every message.

    :param sent: positions (x, y), m, shape (n, 2)
    :param received: likewise, in the order of reception
    :param sent_name: topic it was sent on
    :param received_name: topic it came out on
    """
    figure = Figure(figsize=(6.4, 6.0), layout="constrained")
    axes = figure.add_subplot(
        title="Transmitted and received path", xlabel="x [m]", ylabel="y [m]", aspect="equal", adjustable="datalim"
    )
    one, other = (np.asarray(path, dtype=float).reshape(-1, 2) for path in (sent, received))
    axes.plot(*one.T, color=_SENT, linewidth=5, alpha=0.55, label=f"sent {sent_name} ({len(one)})")
    axes.plot(*other.T, color=_RECEIVED, linewidth=0.9, label=f"received {received_name} ({len(other)})")
    # The red line is thin and its marks shrink with their number, so that the blue below stays visible.
    axes.plot(
        *other.T,
        marker="o",
        linestyle="none",
        color=_RECEIVED,
        markersize=4.0 if len(other) < 200 else 1.5,
        label="each message received",
    )
    axes.plot(
        *one[::SENT_EVERY].T,
        marker="o",
        linestyle="none",
        color=_SENT,
        markersize=6.5,
        markerfacecolor="none",
        markeredgewidth=1.5,
        label=f"every {SENT_EVERY}th message sent",
    )
    axes.grid(alpha=0.3)
    axes.legend(fontsize="small", loc="best")
    return figure


def latency_figure(curves: Mapping[str, Sequence[float]]) -> Figure:
    """Figure 6: the share of delivered messages that took at most so long.

    :param curves: name -> latencies in s, all samples or evenly spaced quantiles; empty ones are left out
    """
    figure = Figure(figsize=(6.4, 4.2), layout="constrained")
    axes = figure.add_subplot(
        title="End-to-end latency", xlabel="latency [ms]", ylabel="share of delivered messages", ylim=(0, 1.02)
    )
    drawn = {name: np.sort(np.asarray(values, dtype=float)) * 1000 for name, values in curves.items() if len(values)}
    for name, values in drawn.items():
        axes.plot(
            values,
            np.linspace(0, 1, len(values)) if len(values) > 1 else [1.0],
            drawstyle="steps-post",
            marker="o" if len(values) == 1 else "",
            label=name,
        )
    lowest = min((values[0] for values in drawn.values()), default=0.0)
    highest = max((values[-1] for values in drawn.values()), default=0.0)
    if lowest > 0 and highest / lowest > 50:
        axes.set_xscale("log")
    axes.grid(alpha=0.3)
    if drawn:
        axes.legend(fontsize="small", loc="lower right")
    else:
        axes.text(0.5, 0.5, "nothing was delivered", ha="center", transform=axes.transAxes)
    return figure


def save_figure(figure: Figure, directory: str | Path, name: str) -> list[Path]:
    """Write NAME.png and NAME.svg.

    :raises ConfigError: when they cannot be written
    """
    paths = [Path(directory) / f"{name}.png", Path(directory) / f"{name}.svg"]
    try:
        Path(directory).mkdir(parents=True, exist_ok=True)
        FigureCanvasAgg(figure).print_figure(paths[0], dpi=150)
        FigureCanvasSVG(figure).print_figure(paths[1], metadata={"Date": None})
    except OSError as error:
        raise ConfigError(f"{directory}: cannot be written ({error.strerror or error})") from error
    return paths
