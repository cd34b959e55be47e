"""The numbers of a sweep: one row per run and topic, and a summary of the repetitions of each cell.

Invariants: every row names its cell by all swept keys; every receiver counts; a row with the topic ``ALL`` holds the
numbers that exist for all topics together, or all numbers if there is only one topic; a share over repetitions or
receivers is the share of all their messages, not a mean of shares.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pa_parquet

from gr_ros2.core.files import write_whole
from gr_ros2.observe.result import TopicResult
from gr_ros2_lab.record.result import Result, topic_numbers
from gr_ros2_lab.record.statistics import Estimate, average, share
from gr_ros2_lab.record.team_numbers import team_numbers
from gr_ros2_lab.record.trace import write_csv
from gr_ros2_lab.study.sweep.definition import PDR, VALUES, SweepCell, SweepPlan

ALL = "all topics"

Results = Mapping[tuple[int, int], Result]
"""(cell number, repetition from 0) -> result. Runs that are not done or that failed are missing."""

_COUNTS = ("sent", "delivered", "corrupt", "relayed")
_PEAKS = ("latency_max_s", "age_peak_s")
_OF_THE_RUN = ("airtime_s", "airtime_per_message_s", "airtime_per_byte_s", "sample_rate")


@dataclass(frozen=True)
class Summary:
    """The numbers of one topic, or of all topics, over the repetitions of a cell.

    :param runs: repetitions with a result
    :param numbers: by the names of ``VALUES``; the PDR has a Wilson interval over all messages, the others have
        Student's t interval over runs
    """

    cell: SweepCell
    topic: str
    runs: int
    sent: int
    delivered: int
    numbers: Mapping[str, Estimate | None]


def rows_of(plan: SweepPlan, results: Results) -> list[dict[str, Any]]:
    """One mapping per run and topic, and one per run for all topics together; cells in their order."""
    rows = []
    ledger = sorted({fate for result in results.values() for topic in _topics(result) for fate in topic.ledger})
    for cell in plan.cells:
        for repetition, scenario in enumerate(cell.runs):
            if (result := results.get((cell.number, repetition))) is None:
                continue
            common = {
                **cell.values,
                "cell": cell.number,
                "repetition": repetition,
                "seed": scenario.seed,
                "duration_s": result.duration_s,
            }
            link = {name: result.phy.get(name) for name in _OF_THE_RUN}
            counts = (result.packets, *(receiver.packets for receiver in result.receivers))
            packets = sum((Counter(of) for of in counts), Counter[str]())
            link.update({f"packets_{name}": packets[name] for name in result.packets})
            of_topic: dict[str, list[dict[str, Any]]] = {}
            for topic in _topics(result):
                of_topic.setdefault(topic.topic, []).append(topic_numbers(topic, ledger))
            topics = [_at_all_receivers(same) for same in of_topic.values()]
            together = {**_together(topics, ALL), **team_numbers(result)}
            rows += [{**common, **topic, **link, "wall_s": result.wall_s} for topic in (together, *topics)]
    return rows


def summaries(plan: SweepPlan, rows: Sequence[Mapping[str, Any]]) -> list[Summary]:
    """The summaries of each cell. The summary of all topics together comes first."""
    groups: dict[tuple[int, str], list[Mapping[str, Any]]] = {}
    for row in rows:
        groups.setdefault((row["cell"], row["topic"]), []).append(row)
    cells = {cell.number: cell for cell in plan.cells}
    return [_summary(cells[number], topic, group) for (number, topic), group in groups.items()]


def summary_rows(found: Sequence[Summary]) -> list[dict[str, Any]]:
    """One mapping per cell and topic, each number with its bounds."""
    return [
        {
            **summary.cell.values,
            "cell": summary.cell.number,
            "topic": summary.topic,
            "runs": summary.runs,
            "sent": summary.sent,
            "delivered": summary.delivered,
            **{
                name + suffix: None if estimate is None else getattr(estimate, part)
                for name, estimate in summary.numbers.items()
                for suffix, part in (("", "value"), ("_low", "low"), ("_high", "high"))
            },
        }
        for summary in found
    ]


def write_tables(rows: Sequence[Mapping[str, Any]], folder: Path, name: str) -> list[Path]:
    """Write NAME.parquet and NAME.csv.

    :raises ConfigError: when they cannot be written
    """
    names = list(dict.fromkeys(name for row in rows for name in row))
    table = pa.table({name: _column([row.get(name) for row in rows]) for name in names})
    return [
        write_whole(folder / f"{name}.parquet", table, pa_parquet.write_table),
        write_whole(folder / f"{name}.csv", table, write_csv),
    ]


def _topics(result: Result) -> list[TopicResult]:
    """Every topic at every receiver."""
    return [topic for topics in (result.topics, *(one.topics for one in result.receivers)) for topic in topics]


def _at_all_receivers(numbers: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The numbers of one topic: counts are added up, of peaks the highest counts, and of other numbers the mean."""
    first = numbers[0]
    if len(numbers) == 1:
        return first
    found = {name: [one[name] for one in numbers if one[name] is not None] for name in first}
    merged = {
        name: first[name]
        if not values or isinstance(values[0], str)
        else max(values)
        if name in _PEAKS
        else sum(values) / len(values)
        for name, values in found.items()
    }
    return {**merged, "src_id": first["src_id"], **_together(numbers, first["topic"])}


def _together(topics: Sequence[dict[str, Any]], name: str) -> dict[str, Any]:
    if len(topics) == 1:
        return {**topics[0], "topic": name}
    counts = [key for key in topics[0] if key in _COUNTS or key.startswith("ledger_")]
    totals = {key: sum(topic[key] for topic in topics) for key in counts}
    goodputs = [topic["goodput_Bps"] for topic in topics if topic["goodput_Bps"] is not None]
    return {
        "topic": name,
        **totals,
        "pdr": totals["delivered"] / totals["sent"] if totals["sent"] else None,
        "goodput_Bps": sum(goodputs) if goodputs else None,
    }


def _summary(cell: SweepCell, topic: str, rows: Sequence[Mapping[str, Any]]) -> Summary:
    sent, delivered = (sum(row[name] for row in rows) for name in ("sent", "delivered"))
    numbers = {
        name: average([row[name] for row in rows if row.get(name) is not None]) for name in VALUES if name != PDR
    }
    return Summary(cell, topic, len(rows), sent, delivered, {PDR: share(delivered, sent), **numbers})


def _column(values: Sequence[Any]) -> Any:
    """A column of a table. Values of one type are stored as they are, values of several types as JSON text."""
    kinds = {type(value) for value in values if value is not None}
    if len(kinds) > 1 and not kinds <= {int, float}:
        return pa.array([None if value is None else json.dumps(value) for value in values], pa.string())
    return pa.array(values, pa.float64() if float in kinds else None)
