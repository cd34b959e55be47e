"""Assigns the swept keys to the axes of the figures, and sorts the summaries into panels, curves and fields.

Invariants: summaries of different settings are never averaged; every combination of the keys that are not on an axis
and not a curve has a panel of its own; an axis is numeric only where every value is a number.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass

from gr_ros2.settings.fields import AUTO
from gr_ros2_lab.record.statistics import Estimate
from gr_ros2_lab.study.sweep.definition import SweepCell, SweepPlan, label
from gr_ros2_lab.study.sweep.summaries import ALL, Summary

NAMES = {
    "channel.snr_db": "SNR [dB]",
    "packet_len": "packet length [B]",
    "phy.name": "PHY",
    "phy.sample_rate": "sample rate [1/s]",
    "channel.packet_loss": "packet loss",
    "channel.frequency_offset": "carrier offset [sample rates]",
    "channel.epsilon": "sample clock ratio",
    "channel.doppler_hz": "Doppler shift [Hz]",
    "scheduler": "scheduler",
    "sim.odom_rate": "odometry [1/s]",
    "duration_s": "duration [s]",
}
"""Axis labels of keys that need a unit or are long. Other keys are their own labels."""

_SNR = "channel.snr_db"
Place = float | str | None
"""A value along an axis."""


@dataclass(frozen=True)
class Axes:
    """The keys of the axes.

    :param y: None where there is no second axis for a heat map
    """

    x: str
    by: tuple[str, ...]
    y: str | None


@dataclass(frozen=True)
class Panel:
    """Summaries with the same values of all keys that are not shown by an axis or a curve.

    :param title: these values; '' where there are none
    :param curves: name -> points (place, estimate) in the order of places
    """

    title: str
    curves: dict[str, list[tuple[Place, Estimate]]]


def choose_axes(plan: SweepPlan) -> Axes:
    """The axes that the sweep defines, or otherwise axes chosen from its keys."""
    sweep = plan.sweep
    keys = [key for key in plan.keys if len(places(plan, key)) > 1] or list(plan.keys[:1])
    numeric = [key for key in keys if all(map(_is_number, places(plan, key)))]
    candidates = [*(key for key in numeric if key == _SNR), *numeric, *keys]
    x = sweep.x if sweep.x != AUTO else next(key for key in candidates if key != sweep.y or len(keys) == 1)
    rest = [key for key in keys if key != x]
    y: str | None = (
        sweep.y if sweep.y != AUTO else next((key for key in numeric if key != x and key not in sweep.by), None)
    )
    by = (
        sweep.by
        if sweep.by != (AUTO,)
        else tuple(key for key in rest if key not in numeric and key != sweep.y) or tuple(rest[:1])
    )
    return Axes(x, by, y)


def curve_panels(plan: SweepPlan, axes: Axes, found: Sequence[Summary]) -> list[Panel]:
    """One panel per combination of the keys that are neither x nor in by, and one curve per combination of by."""
    rest = [key for key in plan.keys if key != axes.x and key not in axes.by]
    panels: dict[Hashable, Panel] = {}
    for summary, estimate in _shown(plan, found):
        values = summary.cell.values
        title = _title(plan, summary.cell, rest)
        panel = panels.setdefault(title, Panel(title, {}))
        panel.curves.setdefault(_title(plan, summary.cell, axes.by), []).append((values[axes.x], estimate))
    order = places(plan, axes.x)
    for panel in panels.values():
        for points in panel.curves.values():
            points.sort(key=lambda point: order.index(point[0]))
    return list(panels.values())


def heat_panels(
    plan: SweepPlan, axes: Axes, found: Sequence[Summary]
) -> list[tuple[str, dict[tuple[Place, Place], float]]]:
    """For each combination of the keys that are neither x nor y: its title, and (x, y) -> value."""
    assert axes.y is not None
    rest = [key for key in plan.keys if key not in (axes.x, axes.y)]
    panels: dict[str, dict[tuple[Place, Place], float]] = {}
    for summary, estimate in _shown(plan, found):
        values = summary.cell.values
        panels.setdefault(_title(plan, summary.cell, rest), {})[values[axes.x], values[axes.y]] = estimate.value
    return list(panels.items())


def places(plan: SweepPlan, key: str) -> list[Place]:
    """Every value of a key. Numbers are in ascending order, other values in the order of the cells."""
    found = list(dict.fromkeys(cell.values[key] for cell in plan.cells))
    return sorted(found) if all(map(_is_number, found)) else found


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _shown(plan: SweepPlan, found: Sequence[Summary]) -> list[tuple[Summary, Estimate]]:
    """The summaries of the topic that is drawn, where its number exists."""
    topic = plan.sweep.topic or ALL
    pairs = [(summary, summary.numbers[plan.sweep.value]) for summary in found if summary.topic == topic]
    return [(summary, estimate) for summary, estimate in pairs if estimate is not None]


def _title(plan: SweepPlan, cell: SweepCell, keys: Sequence[str]) -> str:
    """The values of some keys in a cell, as a title: texts as they are, other values with their key."""
    parts = []
    for key in keys:
        value = cell.values[key]
        if len(places(plan, key)) > 1 and (value is not None or key in cell.point):
            parts.append(value if isinstance(value, str) else label({NAMES.get(key, key): value}))
    return ", ".join(parts)
