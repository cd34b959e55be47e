"""Results as tables: the paper's table 6 with latency beside it, and the loss ledger. Returned, never printed.

Law: a number that does not apply shows as a dash.
"""

from __future__ import annotations

from collections.abc import Sequence

from rich import box
from rich.markup import escape
from rich.table import Table

from gr_ros2.experiment.ledger import DELIVERED
from gr_ros2.experiment.result import Result, TopicResult

_DASH = "–"
_HEADINGS = ("Duration [s]", "Sent", "Recv", "PDR", "Goodput [B/s]", "p50 [ms]", "p95 [ms]", "p99 [ms]")


def summary_table(results: Sequence[Result]) -> Table:
    """One line per topic: config, duration, sent, received, PDR and goodput as in the paper's table 6, and latency."""
    table = _table("Delivery and latency")
    table.add_column("Config", no_wrap=True)
    table.add_column("Topic", overflow="fold")
    for heading in _HEADINGS:
        table.add_column(escape(heading.replace(" ", "\n")), justify="right", no_wrap=True)
    for result in results:
        for topic in result.topics:
            latency = topic.latency_s
            table.add_row(
                escape(result.scenario),
                topic.topic,
                f"{result.duration_s:.1f}",
                str(topic.sent),
                str(topic.delivered),
                _number(topic.pdr, "{:.2f}"),
                _number(topic.goodput_Bps, "{:.1f}"),
                *(_milliseconds(value) for value in (latency.p50, latency.p95, latency.p99)),
            )
        table.add_section()
    return table


def ledger_table(result: Result) -> Table:
    """Where the sent messages of each topic went; rows that are zero for every topic are left out."""
    rows = [DELIVERED, *sorted({row for topic in result.topics for row, count in topic.ledger.items() if count})]
    rows = list(dict.fromkeys(rows))
    table = _table("Where every sent message went")
    table.add_column("Topic", no_wrap=True)
    for heading in ("sent", *rows):
        table.add_column(escape(heading), justify="right")
    for topic in result.topics:
        table.add_row(topic.topic, str(topic.sent), *(str(topic.ledger.get(row, 0)) for row in rows))
    return table


def notes(result: Result) -> list[str]:
    """What a reader of the tables must not miss, one line each: often nothing."""
    lines = [f"{topic.topic}: {topic.corrupt} messages arrived altered" for topic in result.topics if topic.corrupt]
    lines += [_path_note(topic) for topic in result.topics if topic.path_error_m is not None]
    if result.interrupted:
        lines.append(f"stopped after {result.duration_s:.1f} s")
    return lines


def _table(title: str) -> Table:
    # Narrow, so that ten columns fit a terminal of 80 characters.
    return Table(box=box.SIMPLE_HEAD, title=title, title_justify="left", pad_edge=False, collapse_padding=True)


def _path_note(topic: TopicResult) -> str:
    rms = _number(topic.rms_error_m, "{:.3f} m")
    return f"{topic.topic}: path error {topic.path_error_m:.3f} m along the path, RMS {rms} at equal times"


def _milliseconds(seconds: float | None) -> str:
    if seconds is None:
        return _DASH
    value = seconds * 1000
    return f"{value:.{2 if abs(value) < 10 else 1 if abs(value) < 100 else 0}f}"


def _number(value: float | None, form: str) -> str:
    return _DASH if value is None else form.format(value)
