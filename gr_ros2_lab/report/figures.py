"""The figures of an experiment: the paper's figure 7 (paths) and figure 6 (latency), the loss ledger; as PNG and SVG.

Invariants: figures are independent objects; matplotlib's global state is not changed, so figures can be drawn in any
thread, with or without a display.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import cycle
from pathlib import Path

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

from gr_ros2.core.errors import ConfigError
from gr_ros2.link.fates import fate_order
from gr_ros2.observe.colours import AIR_COLOURS, COLOURS, fate_colour
from gr_ros2_lab.record.result import AirUse

SENT_EVERY = 50
"""The paper marks every 50th transmitted message."""

_SENT, _RECEIVED = "#1f5fbf", "#d62728"

_MOST_INSIDE, _COLUMNS = 12, 3
"""Number of curves whose names find room inside the axes; those of more stand below, in so many columns."""
_IN_A_COLUMN, _PANEL_COLUMNS = 6, 4
"""Most axes over the whole width; those of more stand in so many columns."""
_RASTER_ABOVE = 20_000
"""Number of points above which a line is stored as a bitmap in the SVG. Otherwise the file would become too large."""
_DPI = 150
"""Dots per inch of a PNG."""


def panels(count: int, *, same_scale: bool = False) -> tuple[Figure, list[Axes]]:
    """A figure with so many axes over one time: below each other, of many in columns, so that it fits a page.

    :param same_scale: whether all have one scale upwards, too
    """
    columns = 1 if count <= _IN_A_COLUMN else _PANEL_COLUMNS
    rows = max(-(-count // columns), 1)
    figure = Figure(figsize=(8.0, 1.2 + max(1.25 * rows, 2.4)), layout="constrained")
    every = figure.subplots(rows, columns, sharex=True, sharey=same_scale, squeeze=False)
    for axes in every[-1]:
        axes.set_xlabel("time [s]")
    for axes in every.flat[max(count, 1) :]:
        axes.remove()
    return figure, list(every.flat[: max(count, 1)])


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
    raster = max(len(one), len(other)) > _RASTER_ABOVE
    axes.plot(*one.T, color=_SENT, linewidth=5, alpha=0.55, label=f"sent {sent_name} ({len(one)})", rasterized=raster)
    axes.plot(
        *other.T, color=_RECEIVED, linewidth=0.9, label=f"received {received_name} ({len(other)})", rasterized=raster
    )
    # The red line is thin, and its marks are smaller if there are many, so that the blue line below stays visible.
    axes.plot(
        *other.T,
        marker="o",
        linestyle="none",
        color=_RECEIVED,
        markersize=4.0 if len(other) < 200 else 1.5,
        label="each message received",
        rasterized=raster,
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
    """Figure 6: the cumulative distribution of the latency of delivered messages.

    :param curves: name -> latencies in s, all samples or evenly spaced quantiles; empty ones are left out
    """
    drawn = {name: np.sort(np.asarray(values, dtype=float)) * 1000 for name, values in curves.items() if len(values)}
    below = -(-len(drawn) // _COLUMNS) if len(drawn) > _MOST_INSIDE else 0
    figure = Figure(figsize=(6.4, 4.2 + 0.2 * below), layout="constrained")
    axes = figure.add_subplot(
        title="End-to-end latency", xlabel="latency [ms]", ylabel="share of delivered messages", ylim=(0, 1.02)
    )
    for (name, values), colour in zip(drawn.items(), cycle(COLOURS)):
        axes.plot(
            values,
            np.linspace(0, 1, len(values)) if len(values) > 1 else [1.0],
            drawstyle="steps-post",
            marker="o" if len(values) == 1 else "",
            label=name,
            color=colour,
            rasterized=len(values) > _RASTER_ABOVE,
        )
    lowest = min((values[0] for values in drawn.values()), default=0.0)
    highest = max((values[-1] for values in drawn.values()), default=0.0)
    if lowest > 0 and highest / lowest > 50:
        axes.set_xscale("log")
    axes.grid(alpha=0.3)
    if below:
        figure.legend(loc="outside lower center", ncols=_COLUMNS, fontsize="small", frameon=False)
    elif drawn:
        axes.legend(fontsize="small", loc="lower right")
    else:
        axes.text(0.5, 0.5, "nothing was delivered", ha="center", transform=axes.transAxes)
    return figure


def ledger_figure(ledgers: Mapping[str, Mapping[str, int]]) -> Figure:
    """The ledger fates of the sent messages: one bar of 100 % per name, one colour per fate, with the counts.

    :param ledgers: name -> fate -> messages; names without messages are left out
    """
    shown = {name: ledger for name, ledger in ledgers.items() if sum(ledger.values())}
    fates = fate_order(shown.values())
    figure = Figure(figsize=(8.0, 1.5 + 0.42 * max(len(shown), 1)), layout="constrained")
    axes = figure.add_subplot(title="Where every sent message went", xlabel="share of messages sent [%]", xlim=(0, 100))
    left = np.zeros(len(shown))
    places = np.arange(len(shown))
    sent = np.array([sum(ledger.values()) for ledger in shown.values()], dtype=float)
    for fate in fates:
        counts = np.array([ledger.get(fate, 0) for ledger in shown.values()])
        width = counts / sent * 100 if shown else left
        axes.barh(places, width, left=left, height=0.7, color=fate_colour(fate), label=fate.replace("_", " "))
        for place, start, share, count in zip(range(len(shown)), left, width, counts, strict=True):
            if share > 1.5 + 1.2 * len(str(count)):  # where the number fits into the bar
                axes.text(start + share / 2, place, str(count), ha="center", va="center", fontsize=8)
        left += width
    axes.set_yticks(places, [f"{name} ({count:.0f})" for name, count in zip(shown, sent, strict=True)], fontsize=8)
    axes.invert_yaxis()
    if shown:
        figure.legend(loc="outside lower center", ncols=min(len(fates), 5), fontsize="small", frameon=False)
    else:
        axes.text(50, 0, "nothing was sent", ha="center")
    return figure


def air_figure(uses: Sequence[AirUse]) -> Figure:
    """What the packets sent were for: one bar of 100 % of their airtime, with the number of packets of each kind."""
    figure = Figure(figsize=(8.0, 1.7), layout="constrained")
    axes = figure.add_subplot(title="What the air was used for", xlabel="share of the air used [%]", xlim=(0, 100))
    left = 0.0
    for use in uses:
        width = use.share * 100
        axes.barh([0], [width], left=left, height=0.7, color=AIR_COLOURS[use.kind], label=use.kind)
        if width > 1.5 + 1.2 * len(str(use.packets)):  # where the number fits into the bar
            axes.text(left + width / 2, 0, str(use.packets), ha="center", va="center", fontsize=8)
        left += width
    axes.set_yticks([])
    figure.legend(loc="outside lower center", ncols=len(uses) or 1, fontsize="small", frameon=False)
    return figure


def save_figure(figure: Figure, directory: str | Path, name: str, largest_svg: int = 0) -> list[Path]:
    """Write NAME.svg, and NAME.png beside it.

    :param largest_svg: bytes up to which an SVG is enough, and no PNG is written; 0 writes both always
    :return: the files written, the PNG first
    :raises ConfigError: when they cannot be written
    """
    png, svg = Path(directory) / f"{name}.png", Path(directory) / f"{name}.svg"
    try:
        Path(directory).mkdir(parents=True, exist_ok=True)
        FigureCanvasAgg(figure)
        figure.set_dpi(_DPI)
        # The layout is computed once, here. With a layout engine, matplotlib draws every file twice.
        layout = figure.get_layout_engine()
        if layout is not None:
            layout.execute(figure)
            figure.set_layout_engine(None)
        FigureCanvasSVG(figure).print_figure(svg, metadata={"Date": None})
        if svg.stat().st_size <= largest_svg:
            return [svg]
        FigureCanvasAgg(figure).print_figure(png, dpi=_DPI)
    except OSError as error:
        raise ConfigError(f"{directory}: cannot be written ({error.strerror or error})") from error
    return [png, svg]
