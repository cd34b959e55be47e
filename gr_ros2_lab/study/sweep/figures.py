"""The figures of a sweep: curves with intervals, and a heat map. The functions return figures and write no files.

Invariant: as in :mod:`gr_ros2_lab.report.figures`, matplotlib's global state is not changed.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import cycle
from math import ceil, nan
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from gr_ros2.observe.colours import COLOURS
from gr_ros2_lab.study.sweep.axes import NAMES, Panel, Place, choose_axes, curve_panels, heat_panels, places
from gr_ros2_lab.study.sweep.definition import PDR, VALUES, SweepPlan
from gr_ros2_lab.study.sweep.summaries import Summary

MOST_PANELS = 12
"""Most panels in one figure. Data of further panels is in the table only, and the report says so."""

_COLUMNS = 3
_WRITTEN_OUT = 200
"""Number of fields of a heat map up to which each field shows its number."""
_LONGEST = 32
"""Characters of a value at an axis or a curve. Of a longer one, such as a path, the end is shown; all of it would leave
no room to draw in."""


def curves_figure(plan: SweepPlan, found: Sequence[Summary]) -> tuple[Figure, int]:
    """The value against x, a curve per ``by``, with 95 % intervals; and how many panels were left out."""
    axes = choose_axes(plan)
    panels = curve_panels(plan, axes, found)
    figure, grid = _grid(min(len(panels), MOST_PANELS), 6.4, 4.4)
    for panel, field in zip(panels, grid, strict=False):
        _draw_curves(field, panel, places(plan, axes.x))
        _name(field, plan, axes.x, panel.title)
        field.set_ylabel(_value_name(plan))
        if plan.sweep.value == PDR:
            field.set_ylim(-0.03, 1.03)
        field.grid(alpha=0.3)
        if list(panel.curves) != [""]:
            title = ", ".join(NAMES.get(key, key) for key in axes.by)
            style: dict[str, Any] = {"fontsize": "small", "title": title, "title_fontsize": "small", "frameon": False}
            # The legend is below the panel, where it hides no point.
            field.legend(loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=2, **style)
    return figure, max(len(panels) - MOST_PANELS, 0)


def heat_figure(plan: SweepPlan, found: Sequence[Summary]) -> tuple[Figure, int] | None:
    """The value over x and y, and how many panels were left out; None where the sweep has no second axis."""
    axes = choose_axes(plan)
    if axes.y is None:
        return None
    panels = heat_panels(plan, axes, found)
    columns, rows = places(plan, axes.x), places(plan, axes.y)
    values = [value for _, fields in panels for value in fields.values()]
    low, high = (0.0, 1.0) if plan.sweep.value == PDR else (min(values, default=0.0), max(values, default=1.0))
    width, height = 1.8 + 0.5 * max(len(columns), 8), 1.4 + 0.35 * max(len(rows), 6)
    figure, grid = _grid(min(len(panels), MOST_PANELS), width, height)
    image = None
    for (title, fields), field in zip(panels, grid, strict=False):
        table = np.array([[fields.get((x, y), nan) for x in columns] for y in rows], dtype=float)
        image = field.imshow(table, origin="lower", aspect="auto", vmin=low, vmax=high, cmap="viridis")
        _name(field, plan, axes.x, title)
        field.set_ylabel(NAMES.get(axes.y, axes.y))
        field.set_xticks(range(len(columns)), [_text(x) for x in columns])
        field.set_yticks(range(len(rows)), [_text(y) for y in rows])
        if table.size <= _WRITTEN_OUT:
            _write_out(field, table, (low + high) / 2)
    if image is not None:
        figure.colorbar(image, ax=grid, label=_value_name(plan))
    return figure, max(len(panels) - MOST_PANELS, 0)


def _grid(count: int, width: float, height: float) -> tuple[Figure, list[Any]]:
    """A figure with this number of panels, each of this size in inches."""
    columns = min(max(count, 1), _COLUMNS)
    rows = ceil(max(count, 1) / columns)
    figure = Figure(figsize=(width * columns, height * rows), layout="constrained")
    grid = list(figure.subplots(rows, columns, squeeze=False).flat)
    for unused in grid[max(count, 1) :]:
        unused.set_axis_off()
    return figure, grid[: max(count, 1)]


def _draw_curves(field: Any, panel: Panel, order: Sequence[Place]) -> None:
    numeric = all(isinstance(place, (int, float)) for place in order)
    for (name, points), colour in zip(panel.curves.items(), cycle(COLOURS)):
        xs = [place if numeric else order.index(place) for place, _ in points]
        ys = [estimate.value for _, estimate in points]
        below = [0.0 if estimate.low is None else estimate.value - estimate.low for _, estimate in points]
        above = [0.0 if estimate.high is None else estimate.high - estimate.value for _, estimate in points]
        style: dict[str, Any] = {"marker": "o", "markersize": 3.5, "linewidth": 1.2, "capsize": 2.5}
        field.errorbar(xs, ys, yerr=[below, above], label=_text(name) if name else None, color=colour, **style)
    if not numeric:
        field.set_xticks(range(len(order)), [_text(place) for place in order])


def _write_out(field: Any, table: Any, middle: float) -> None:
    for (row, column), value in np.ndenumerate(table):
        if not np.isnan(value):
            colour = "black" if value > middle else "white"
            field.text(column, row, f"{value:.2g}", ha="center", va="center", fontsize=7, color=colour)


def _name(field: Any, plan: SweepPlan, x: str, title: str) -> None:
    field.set_title(title or plan.sweep.description or plan.name, fontsize="medium")
    field.set_xlabel(NAMES.get(x, x))


def _value_name(plan: SweepPlan) -> str:
    topic = plan.sweep.topic
    return VALUES[plan.sweep.value] + (f" of {topic}" if topic else "")


def _text(place: Place) -> str:
    if place is None:
        return "none"
    text = f"{place:g}" if isinstance(place, (int, float)) and not isinstance(place, bool) else str(place)
    return text if len(text) <= _LONGEST else f"…{text[1 - _LONGEST :]}"
