"""The results of the race: a table, also in Markdown, `race.json`, the cells as CSV and Parquet, one figure.

Invariants: a file is written completely or not at all. Only the numbers decide which contender is marked as a winner.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pa_parquet
from matplotlib.figure import Figure

from gr_ros2 import __version__
from gr_ros2.core.files import write_text, write_whole
from gr_ros2.observe.colours import COLOURS
from gr_ros2_lab.race.contenders import CONTENDERS
from gr_ros2_lab.race.measure import COLUMNS, RaceCell, ahead, by_condition, columns, shown, winners
from gr_ros2_lab.race.race_settings import dump
from gr_ros2_lab.race.runner import Race
from gr_ros2_lab.record.trace import write_csv
from gr_ros2_lab.report.figures import save_figure
from gr_ros2_lab.report.table import Grid

RACE_FILE = "race.json"
WON = "*"
OURS = "gr-ros2"
"""The contender with the program's own defaults."""
_DRAWN = ("pdr", "age_mean", "latency_p99", "airtime_per_message", "first_message")
_DRAWN_OF_TEAMS = ("pdr", "age_mean", "age_peak", "air_bytes_per_message", "all_heard")
_LINEAR = {"pdr"}


def race_grid(race: Race) -> Grid:
    """One section per condition, one line per contender. A star marks the best contenders of a column."""
    shown_columns = columns(race.cells)
    sections = []
    for (load, loss), cells in by_condition(race.cells).items():
        best = winners(cells)
        sections.append(
            tuple(
                (
                    f"{load:.0%}",
                    f"{loss:.0%}",
                    cell.contender,
                    *(shown(cell, name) + (WON if cell.contender in best[name] else " ") for name in shown_columns),
                )
                for cell in cells
            )
        )
    headings = ("Load", "Loss", "Contender", *(column.heading for column in shown_columns.values()))
    return Grid(f"The race ({WON} best of its group)", headings, tuple(sections), texts=3)


def race_markdown(race: Race) -> str:
    """The table in Markdown, the best of a condition in bold, and who is ahead of ours and where."""
    shown_columns = columns(race.cells)
    headings = ["Load", "Loss", "Contender", *(column.heading for column in shown_columns.values())]
    lines = [f"| {' | '.join(headings)} |", "|" + "---|" * len(headings)]
    for (load, loss), cells in by_condition(race.cells).items():
        best = winners(cells)
        for cell in cells:
            numbers = [
                f"**{shown(cell, name)}**" if cell.contender in best[name] else shown(cell, name)
                for name in shown_columns
            ]
            lines.append(f"| {load:.0%} | {loss:.0%} | `{cell.contender}` | {' | '.join(numbers)} |")
    return "\n".join([*lines, "", *(f"- {line}" for line in ahead_of_ours(race)), ""])


def ahead_of_ours(race: Race) -> list[str]:
    """One line per condition: in which columns which contenders are better than ours."""
    lines = []
    for (load, loss), cells in by_condition(race.cells).items():
        if not any(cell.contender == OURS for cell in cells):
            continue
        where = [f"{COLUMNS[name].heading} ({', '.join(who)})" for name, who in ahead(cells, OURS).items()]
        lines.append(f"load {load:.0%}, loss {loss:.0%}: ahead of {OURS}: {'; '.join(where) or 'nobody'}")
    return lines


def notes(race: Race) -> list[str]:
    """Facts that a reader of the table must know, one line each."""
    recording = race.recording
    robots = race.settings.robots
    size = sum(map(len, recording.payloads)) / len(recording.payloads)
    rates = dict.fromkeys((cell.load, cell.sample_rate) for cell in race.cells)
    lines = [
        (f"{robots} robots on one channel, each with a topic such as " if robots else "")
        + f"{recording.topic}: {len(recording.payloads)} messages of {size:.0f} B on average, {recording.hz:.1f}/s; "
        + "; ".join(f"load {load:.0%} is {rate:,.0f} samples/s" for load, rate in rates)
    ]
    lines += ahead_of_ours(race)
    for cell in race.cells:
        where = f"{cell.contender}, load {cell.load:.0%}, loss {cell.loss:.0%}"
        if not cell.matched:
            lines.append(f"{where}: the ends did not find each other before the first message")
        if robots and cell.all_heard is None:
            lines.append(f"{where}: not every robot heard every other one; ages are those of the pairs that did")
        if cell.altered or cell.duplicates:
            lines.append(f"{where}: {cell.altered} messages arrived altered, {cell.duplicates} twice")
    if (busy := max((cell.busy for cell in race.cells), default=0)) > 1:
        lines.append(
            f"the computer was busy, up to {busy:.1f} programs per processor: times are longer than the radio's"
        )
    if race.interrupted or race.error is not None:
        lines.append("stopped before all cells were run")
    return lines


def write_race(race: Race, out: Path) -> list[Path]:
    """Write all files into a folder, which is created if missing. The race must have at least one cell.

    :return: the files, `race.json` first
    :raises ConfigError: when they cannot be written
    """
    text = json.dumps(_values(race), indent=2, allow_nan=False) + "\n"
    table = _table(race.cells)
    return [
        write_whole(out / RACE_FILE, text, write_text),
        write_whole(out / "race.md", race_markdown(race), write_text),
        write_whole(out / "race.csv", table, write_csv),
        write_whole(out / "race.parquet", table, pa_parquet.write_table),
        *save_figure(race_figure(race.cells), out, "race"),
    ]


def race_figure(cells: Sequence[RaceCell]) -> Figure:
    """One row per number, one column per load. Bars are grouped by loss; each contender has its own colour."""
    loads, losses = sorted({cell.load for cell in cells}), sorted({cell.loss for cell in cells})
    names = [name for name in CONTENDERS if any(cell.contender == name for cell in cells)]
    found = {(cell.contender, cell.load, cell.loss): cell for cell in cells}
    drawn = _DRAWN_OF_TEAMS if any(cell.robots for cell in cells) else _DRAWN
    figure = Figure(figsize=(2.2 + 3.6 * len(loads), 1.2 + 1.9 * len(drawn)), layout="constrained")
    axes = figure.subplots(len(drawn), len(loads), squeeze=False, sharex=True, sharey="row")
    places = np.arange(len(losses))
    width = 0.84 / len(names)
    for row, number in enumerate(drawn):
        for column, load in enumerate(loads):
            panel = axes[row][column]
            for index, name in enumerate(names):
                picked = [found.get((name, load, loss)) for loss in losses]
                values = [np.nan if cell is None else getattr(cell, number) for cell in picked]
                heights = np.array([np.nan if value is None else value for value in values], dtype=float)
                heights *= 1000 if "[ms]" in COLUMNS[number].heading else 1
                offset = (index - (len(names) - 1) / 2) * width
                panel.bar(places + offset, heights, width, color=COLOURS[index], label=name)
            if number not in _LINEAR:
                panel.set_yscale("log")
            panel.grid(axis="y", alpha=0.3)
            if not row:
                panel.set_title(f"load {load:.0%} of the link")
            if not column:
                panel.set_ylabel(COLUMNS[number].heading)
    for panel in axes[-1]:
        panel.set_xticks(places, [f"loss {loss:.0%}" for loss in losses])
    handles, labels = axes[0][0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize="small", frameon=False)
    return figure


def _values(race: Race) -> dict[str, Any]:
    recording = race.recording
    return {
        "settings": dump(race.settings),
        "recording": {
            "topic": recording.topic,
            "type": recording.type_name,
            "messages": len(recording.payloads),
            "bytes": sum(map(len, recording.payloads)),
            "hz": recording.hz,
        },
        "contenders": {
            name: {"summary": contender.summary, "reliable": contender.reliable}
            for name, contender in CONTENDERS.items()
        },
        "cells": [asdict(cell) for cell in race.cells],
        "winners": [
            {"load": load, "loss": loss, **winners(cells)} for (load, loss), cells in by_condition(race.cells).items()
        ],
        "versions": {"gr-ros2": __version__, **{name: _version(name) for name in ("cyclonedds", "eclipse-zenoh")}},
        "interrupted": race.interrupted,
        "error": None if race.error is None else str(race.error),
    }


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _table(cells: Sequence[RaceCell]) -> Any:
    names = sorted({name for cell in cells for name in cell.drops})
    lines = []
    for cell in cells:
        values = asdict(cell)
        drops = values.pop("drops")
        lines.append({**values, **{f"dropped_{name}": drops.get(name, 0) for name in names}})
    return pa.Table.from_pylist(lines)
