"""The results of a sweep as files: tables, figures, and a page with both.

Invariant: everything is made from the rows alone, so the page of an incomplete sweep has the same form as that of a
finished one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import yaml

from gr_ros2_lab.record.statistics import Estimate
from gr_ros2_lab.report.page import Drawings, Picture, Section, render_page
from gr_ros2_lab.report.table import Grid, number
from gr_ros2_lab.study.sweep.definition import PDR, VALUES, SweepPlan
from gr_ros2_lab.study.sweep.figures import curves_figure, heat_figure
from gr_ros2_lab.study.sweep.summaries import ALL, Results, Summary, rows_of, summaries, summary_rows, write_tables

PAGE_FILE = "sweep.html"
RUNS_TABLE, CELLS_TABLE = "sweep", "cells"

_SHOWN = (PDR, "goodput_Bps", "latency_p50_s", "latency_p99_s", "age_mean_s")


def write_sweep(plan: SweepPlan, results: Results, failures: Sequence[str], folder: Path) -> list[Path]:
    """Write `sweep.html`, the tables and the figures.

    :param failures: runs without a result, one line each
    :return: the files written, the page first
    :raises ConfigError: when they cannot be written
    """
    rows = rows_of(plan, results)
    found = summaries(plan, rows)
    tables = write_tables(rows, folder, RUNS_TABLE) + write_tables(summary_rows(found), folder, CELLS_TABLE)
    pictures, notes = _draw(plan, found, folder)
    wanted = sum(len(cell.runs) for cell in plan.cells)
    sentences = [
        *notes,
        *(f"failed: {line}" for line in failures),
        *([f"{wanted - len(results)} of {wanted} runs are missing"] if len(results) < wanted else []),
    ]
    lead = (
        f"{plan.sweep.description or plan.name} · {len(plan.cells)} cells of {plan.sweep.scenario}, "
        f"{plan.sweep.repetitions} runs each, time by {plan.sweep.time}"
    )
    settings = {"Cells": yaml.safe_dump([dict(cell.point) for cell in plan.cells], sort_keys=False, allow_unicode=True)}
    sections = [
        Section(sentences=sentences, pictures=pictures),
        Section(heading="Numbers", lead=_INTERVALS, grids=[summary_grid(plan, found)], details=settings),
    ]
    return render_page(folder / PAGE_FILE, plan.name, lead, sections, tables)


_INTERVALS = (
    "In brackets, after ± and as bars: 95 % intervals, of the PDR by Wilson over all messages of a cell, of other "
    "numbers by Student over its runs."
)


def summary_grid(plan: SweepPlan, found: Sequence[Summary], shown: Sequence[str] = _SHOWN) -> Grid:
    """A line per cell and topic. If there are several topics, each cell has a section. Topics that have none of the
    numbers have no lines.

    :param shown: names of ``VALUES``
    """
    topics = {ALL} | {one.topic for one in found if any(one.numbers[name] is not None for name in shown)}
    found = [summary for summary in found if summary.topic in topics]
    several = len(topics) > 2  # with one topic, "all topics" says the same
    lines: dict[int, list[tuple[str, ...]]] = {}
    first = next((summary.topic for summary in found), "")
    columns = [_Column.of(name, [summary.numbers[name] for summary in found]) for name in shown]
    for summary in found:
        if several or summary.topic == first:
            lines.setdefault(summary.cell.number, []).append(
                (
                    *(_plain(summary.cell.values[key]) for key in plan.keys),
                    *([summary.topic] if several else []),
                    str(summary.runs),
                    str(summary.sent),
                    *(column.cell(summary.numbers[name]) for name, column in zip(shown, columns, strict=True)),
                )
            )
    headings = (*plan.keys, *(["topic"] if several else []), "runs", "sent", *(one.heading for one in columns))
    sections = [tuple(cell) for cell in lines.values()]
    if not several:
        sections = [tuple(line for section in sections for line in section)]
    return Grid(f"{len(lines)} cells", headings, tuple(sections), texts=len(plan.keys) + several)


def _draw(plan: SweepPlan, found: Sequence[Summary], folder: Path) -> tuple[list[Picture], list[str]]:
    pictures, notes = [], []
    for name, drawn in (("curves", curves_figure(plan, found)), ("heatmap", heat_figure(plan, found))):
        if drawn is None:
            continue
        figure, left_out = drawn
        caption = f"{VALUES[plan.sweep.value]}, " + ("with 95 % intervals" if name == "curves" else "over two settings")
        pictures.append(Drawings(folder).save(figure, name, caption, wide=True))
        if left_out:
            notes.append(f"{name}: {left_out} further panels are in the tables only; name fewer keys, or set by")
    return pictures, notes


@dataclass(frozen=True)
class _Column:
    """How a number of ``VALUES`` is written: with the unit and the digits that its largest value needs.

    :param form: format of one number, after it was divided by ``scale``
    :param even: whether an interval is as long on both sides
    """

    heading: str
    scale: float
    form: str
    even: bool = True

    @classmethod
    def of(cls, name: str, estimates: Sequence[Estimate | None]) -> _Column:
        label = VALUES[name]
        if name == PDR:
            return cls(label, 1.0, "{:.3f}", even=False)
        largest = max((abs(one.value) for one in estimates if one is not None), default=0.0)
        scale = 1.0
        if largest >= 1e3 and "[B/s]" in label:
            label, scale = label.replace("[B/s]", "[kB/s]"), 1e3
        elif largest < 1 and "[s]" in label:
            label, scale = label.replace("[s]", "[ms]"), 1e-3
        digits = 0 if largest >= 1000 * scale else 1 if largest >= 10 * scale else 3
        return cls(label, scale, f"{{:.{digits}f}}")

    def cell(self, estimate: Estimate | None) -> str:
        if estimate is None or estimate.low is None or estimate.high is None:
            return number(None if estimate is None else estimate.value / self.scale, self.form)
        value, low, high = (one / self.scale for one in (estimate.value, estimate.low, estimate.high))
        write = self.form.format
        if self.even:
            return f"{write(value)} ± {write((high - low) / 2)}"
        return f"{write(value)} [{write(low)}, {write(high)}]"


def _plain(value: object) -> str:
    return f"{value:g}" if isinstance(value, float) else "–" if value is None else str(value)
