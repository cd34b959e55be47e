"""Comparison of runs: one table with a column per run, and figures with a curve per run.

Invariant: all numbers come from the runs' own files; a dash means that a run does not have the topic or the number.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from gr_ros2.link.ledger_rows import LedgerRow, row_order
from gr_ros2.record.result import TopicResult
from gr_ros2.record.trace import Messages
from gr_ros2.report.figures import latency_figure, ledger_figure
from gr_ros2.report.page import Run, Section, latencies, lead_of, save, write_page
from gr_ros2.report.table import Grid, milliseconds, number
from gr_ros2.report.timelines import Deliveries, age_figure, delivery_figure

COMPARISON_FILE = "compare.html"

_NUMBERS: dict[str, Callable[[TopicResult], str]] = {
    "sent": lambda topic: str(topic.sent),
    "delivered": lambda topic: str(topic.delivered),
    "PDR": lambda topic: number(topic.pdr, "{:.3f}"),
    "goodput [B/s]": lambda topic: number(topic.goodput_Bps, "{:.1f}"),
    "latency p50 [ms]": lambda topic: milliseconds(topic.latency_s.p50),
    "latency p95 [ms]": lambda topic: milliseconds(topic.latency_s.p95),
    "latency p99 [ms]": lambda topic: milliseconds(topic.latency_s.p99),
    "latency max [ms]": lambda topic: milliseconds(topic.latency_s.max),
    "age mean [ms]": lambda topic: milliseconds(topic.age_s.mean),
    "age peak [ms]": lambda topic: milliseconds(topic.age_s.peak),
    "path error [m]": lambda topic: number(topic.path_error_m, "{:.3f}"),
    "RMS error [m]": lambda topic: number(topic.rms_error_m, "{:.3f}"),
}
_PHY = {
    "airtime of a packet [ms]": "airtime_s",
    "airtime per message delivered [ms]": "airtime_per_message_s",
    "airtime per byte delivered [ms]": "airtime_per_byte_s",
}
_DASH = "–"


def compare_grid(runs: Sequence[Run]) -> Grid:
    """A section per topic and a column per run. The numbers of the link come last. Numbers that no run has are left
    out."""
    by_topic = [{topic.topic: topic for topic in run.result.topics} for run in runs]
    sections = []
    for name in dict.fromkeys(name for topics in by_topic for name in topics):
        found = [topics.get(name) for topics in by_topic]
        rows = row_order(topic.ledger for topic in found if topic is not None)
        lines = [
            (name, what, *(_DASH if topic is None else of(topic) for topic in found)) for what, of in _NUMBERS.items()
        ]
        lines += [
            (
                name,
                row.replace("_", " "),
                *(_DASH if topic is None else str(topic.ledger.get(row, 0)) for topic in found),
            )
            for row in rows
            if row != LedgerRow.DELIVERED
        ]
        sections.append(lines)
    results = [run.result for run in runs]
    link = [("link", "duration [s]", *(f"{result.duration_s:.1f}" for result in results))]
    for count in dict.fromkeys(name for result in results for name in result.packets):
        link.append(
            (
                "link",
                f"packets {count.replace('_', ' ')}",
                *(str(result.packets.get(count, _DASH)) for result in results),
            )
        )
    link += [("link", what, *(milliseconds(result.phy.get(key)) for result in results)) for what, key in _PHY.items()]
    kept = [tuple(line for line in section if set(line[2:]) != {_DASH}) for section in [*sections, link]]
    return Grid("Side by side", ("Topic", "Number", *(run.label for run in runs)), tuple(filter(None, kept)), texts=2)


def write_comparison(runs: Sequence[Run], out: Path, first: Sequence[Grid] = ()) -> list[Path]:
    """Write ``compare.html``, its figures and the table of all numbers.

    :param first: tables that are placed before the table of all numbers
    :return: the files written, the page first
    :raises ConfigError: when they cannot be written
    """
    messages = {run.label: run.messages() for run in runs}
    panels: dict[str, dict[str, Messages]] = {}
    for label, topics in messages.items():
        for m in topics:
            panels.setdefault(m.topic, {})[label] = m
    duration = max(run.result.duration_s for run in runs)
    ledgers = {
        f"{topic.topic}, {run.label}": topic.ledger
        for name in panels
        for run in runs
        for topic in run.result.topics
        if topic.topic == name
    }
    deliveries = {label: Deliveries.of(topics) for label, topics in messages.items()}
    pictures = [
        save(latency_figure(latencies(runs)), out, "latency", "End-to-end latency"),
        save(ledger_figure(ledgers), out, "ledger", "Where every sent message went; in brackets how many were sent"),
        save(delivery_figure(deliveries, duration), out, "delivery", "PDR and goodput over time, all topics together"),
        save(
            age_figure(panels, {run.label: run.trace.t_end for run in runs}),
            out,
            "age",
            "Age of the newest message delivered, per topic",
        ),
    ]
    title = " · ".join(run.label for run in runs)
    sections = [
        Section(sentences=[f"{run.label}: {lead_of(run)}" for run in runs], grids=[*first, compare_grid(runs)]),
        Section(pictures=pictures),
    ]
    return write_page(out / COMPARISON_FILE, title, f"{len(runs)} runs side by side", sections, runs)
