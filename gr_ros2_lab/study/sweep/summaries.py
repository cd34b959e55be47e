"""The numbers of a sweep: one row per run and topic, and a summary of the repetitions of each cell.

Invariants: every row names its cell by all swept keys; a row with the topic ``ALL`` holds the numbers that exist for
all topics together, or all numbers if there is only one topic; a share over repetitions is the share of all their
messages, not a mean of shares.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pa_parquet

from gr_ros2.core.files import write_whole
from gr_ros2_lab.record.result import Result, topic_numbers
from gr_ros2_lab.record.statistics import Estimate, average, share
from gr_ros2_lab.record.team_numbers import team_numbers
from gr_ros2_lab.record.trace import write_csv
from gr_ros2_lab.study.sweep.definition import PDR, VALUES, SweepCell, SweepPlan

ALL = "all topics"

Results = Mapping[tuple[int, int], Result]
"""(cell number, repetition from 0) -> result. Runs that are not done or that failed are missing."""

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
    ledger = sorted({fate for result in results.values() for topic in result.topics for fate in topic.ledger})
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
            link.update({f"packets_{name}": count for name, count in result.packets.items()})
            topics = [topic_numbers(topic, ledger) for topic in result.topics]
            together = {**_together(topics), **team_numbers(result)}
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


def _together(topics: Sequence[dict[str, Any]]) -> dict[str, Any]:
    if len(topics) == 1:
        return {**topics[0], "topic": ALL}
    counts = [name for name in topics[0] if name in ("sent", "delivered", "corrupt") or name.startswith("ledger_")]
    totals = {name: sum(topic[name] for topic in topics) for name in counts}
    goodputs = [topic["goodput_Bps"] for topic in topics if topic["goodput_Bps"] is not None]
    return {
        "topic": ALL,
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
