"""The results of the race: a table, also in Markdown, `race.json`, cells as CSV and Parquet, one picture per question.

Invariants: a file is written completely or not at all. Only the numbers decide which contender is marked as a winner.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, version
from math import inf
from pathlib import Path
from typing import Any, NamedTuple

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
OURS_COLOUR, THEIRS_COLOUR = COLOURS[1], COLOURS[0]


class _Question(NamedTuple):
    """What a picture answers.

    :param number: field of :class:`RaceCell`
    """

    text: str
    number: str
    logarithmic: bool = True


QUESTIONS = {
    "arrived": _Question("How many messages arrive?", "pdr", logarithmic=False),
    "age": _Question("How old is what the receiver has, 95 % of the time?", "age_p95"),
    "air": _Question("How much air does a message take?", "air_bytes_per_message"),
    "processor": _Question("How much processor does a message take?", "processor_per_message"),
    "first": _Question("When is the first message there?", "first_message"),
    "heard": _Question("When do all hear all?", "all_heard"),
    "fresh": _Question("How soon after an outage is the newest message fresh?", "fresh_after"),
    "lost": _Question("How many messages does an outage cost?", "lost", logarithmic=False),
    "beside": _Question("When is all there that goes beside the odometry?", "beside_done"),
    "pictures": _Question("How many pictures arrive?", "beside_delivered", logarithmic=False),
}
"""The pictures of a race, by name: one question each."""


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
        *(
            path
            for name, figure in race_figures(race.cells).items()
            for path in save_figure(figure, out, f"race-{name}")
        ),
    ]


def race_figures(cells: Sequence[RaceCell]) -> dict[str, Figure]:
    """A picture for each question that these cells answer, by name."""
    asked = columns(cells)
    questions = {name: question for name, question in QUESTIONS.items() if question.number in asked}
    found = {name: _figure(cells, question) for name, question in questions.items()}
    return {name: figure for name, figure in found.items() if figure is not None}


def _figure(cells: Sequence[RaceCell], question: _Question) -> Figure | None:
    """Bars of every contender, the best on top: one panel per load and loss. None: nobody has the number."""
    groups = [
        [(cell.contender, getattr(cell, question.number)) for cell in group] for group in by_condition(cells).values()
    ]
    if all(value is None for group in groups for _, value in group):
        return None
    names = [name for name in CONTENDERS if any(cell.contender == name for cell in cells)]
    column = COLUMNS[question.number]
    figure = Figure(figsize=(1.4 + 3.2 * len(groups), 1.2 + 0.24 * len(names)), layout="constrained")
    panels = figure.subplots(1, len(groups), squeeze=False, sharex=True)[0]
    for panel, group, (load, loss) in zip(panels, groups, by_condition(cells), strict=True):
        sign = -1 if column.better == "least" else 1
        order = sorted(group, key=lambda pair: -inf if pair[1] is None else sign * pair[1])
        for place, (name, value) in enumerate(order):
            if value is None:
                panel.annotate(
                    "never", (0, place), (3, 0), panel.get_yaxis_transform(), "offset points", va="center", size=7
                )
                continue
            height = 1000 * value if "[ms]" in column.heading else value
            panel.barh(place, height, color=OURS_COLOUR if name.startswith(OURS) else THEIRS_COLOUR)
            panel.annotate(
                column.shown(value), (height, place), (3, 0), textcoords="offset points", va="center", size=7
            )
        panel.set_yticks(range(len(order)), [name for name, _ in order], fontsize=7)
        panel.set_title(f"load {load:.0%}, loss {loss:.0%}", fontsize=8)
        panel.margins(x=0.15)
        if question.logarithmic and all(value is None or value > 0 for _, value in group):
            panel.set_xscale("log")
    figure.suptitle(question.text, fontsize=9)
    figure.supxlabel(column.heading, fontsize=8)
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
