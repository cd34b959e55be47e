"""Comparison of runs: one table with a column per run, and figures with a curve per run.

Invariant: all numbers come from the runs' own files; a dash means that a run does not have the topic or the number.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from gr_ros2.link.fates import Fate, fate_order
from gr_ros2.observe.result import TopicResult
from gr_ros2_lab.record.team_numbers import TEAM_VALUES, team_numbers
from gr_ros2_lab.record.trace import Messages
from gr_ros2_lab.report.explain import lateness_lines
from gr_ros2_lab.report.figures import latency_figure, ledger_figure
from gr_ros2_lab.report.page import (
    Drawings,
    Picture,
    Run,
    Section,
    drawing,
    latencies,
    lead_of,
    render_page,
    write_summary,
)
from gr_ros2_lab.report.table import Grid, milliseconds, number, whose_view
from gr_ros2_lab.report.timelines import Deliveries, age_figure, delivery_figure

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
    """What differs, with a column per run: the settings, all robots of a team, a section per topic of the first
    receiver, and its link. What is equal in all runs is left out, and so are their names where they head the columns.
    """
    by_topic = [{topic.topic: topic for topic in run.result.topics} for run in runs]
    sections = []
    for name in dict.fromkeys(name for topics in by_topic for name in topics):
        found = [topics.get(name) for topics in by_topic]
        fates = fate_order(topic.ledger for topic in found if topic is not None)
        lines = [
            (name, what, *(_DASH if topic is None else of(topic) for topic in found)) for what, of in _NUMBERS.items()
        ]
        lines += [
            (
                name,
                fate.replace("_", " "),
                *(_DASH if topic is None else str(topic.ledger.get(fate, 0)) for topic in found),
            )
            for fate in fates
            if fate != Fate.DELIVERED
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
    teams = [team_numbers(result) for result in results]
    team = [
        ("all robots", label, *(number(numbers.get(name), "{:.3g}") for numbers in teams))
        for name, label in TEAM_VALUES.items()
    ]
    labels = tuple(run.label for run in runs)
    lines_of = [_settings([result.config for result in results]), team, *sections, link]
    kept = [tuple(line for line in section if len(set(line[2:])) > 1 and line[2:] != labels) for section in lines_of]
    view = whose_view(results[0])
    title = ("What differs" + f"; topics and link {view}" * bool(view)) if any(kept) else "Nothing differs"
    return Grid(title, ("", "", *labels), tuple(filter(None, kept)), texts=2)


def _settings(configs: Sequence[Mapping[str, Any]]) -> list[tuple[str, ...]]:
    """A line per setting. Where a block follows from another setting, such as packet_len, only the latter is named."""
    flat = [{name: text for name, text in _flat(config) if name != "description"} for config in configs]
    names = dict.fromkeys(name for settings in flat for name in settings)
    lines = {name: ("setting", name, *(settings.get(name, _DASH) for settings in flat)) for name in names}
    return [
        line
        for name, line in lines.items()
        if "." not in name or lines.get(name.rpartition(".")[2], ("", ""))[2:] != line[2:]
    ]


def _flat(values: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, str]]:
    for key, value in values.items():
        if isinstance(value, Mapping) and value:
            yield from _flat(value, f"{above}{key}.")
        else:
            yield above + key, value if isinstance(value, str) else json.dumps(value)  # as after --set


def lateness_of(runs: Sequence[Run]) -> list[str]:
    """The runs in which the computer did not keep up: what differs may be an effect of that."""
    return [f"{run.label}: {line}" for run in runs for line in lateness_lines(run.result)]


def write_comparison(
    runs: Sequence[Run], out: Path, first: Sequence[Grid] = (), *, pictures: bool = False
) -> list[Path]:
    """Write ``compare.html``, which has its figures in it, and the table of all numbers.

    :param first: tables that are placed before that of what differs
    :param pictures: write the figures as PNG and SVG too
    :return: the files written, the page first
    :raises ConfigError: when they cannot be written
    """
    title = " · ".join(run.label for run in runs)
    with drawing(out, pictures) as drawn:
        sections = [
            Section(
                sentences=[*lateness_of(runs), *(f"{run.label}: {lead_of(run)}" for run in runs)],
                grids=[*first, compare_grid(runs)],
            ),
            Section(pictures=_draw(runs, drawn)),
        ]
        return render_page(
            out / COMPARISON_FILE, title, f"{len(runs)} runs side by side", sections, write_summary(runs, out)
        )


def _draw(runs: Sequence[Run], out: Drawings) -> list[Picture]:
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
    return [
        out.save(latency_figure(latencies(runs)), "latency", "End-to-end latency"),
        out.save(ledger_figure(ledgers), "ledger", "Where every sent message went; in brackets how many were sent"),
        out.save(delivery_figure(deliveries, duration), "delivery", "PDR and goodput over time, all topics together"),
        out.save(
            age_figure(panels, {run.label: run.trace.t_end for run in runs}),
            "age",
            "Age of the newest message delivered, per topic",
        ),
    ]
