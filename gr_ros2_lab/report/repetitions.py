"""The headline numbers of one experiment that was run several times, as a grid."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from gr_ros2_lab.record.repetitions import TopicSummary, summarize
from gr_ros2_lab.record.result import Result
from gr_ros2_lab.record.statistics import CONFIDENCE, Estimate
from gr_ros2_lab.report.table import Grid, number


@dataclass(frozen=True)
class _Headline:
    """How a number of a topic is shown: its heading, its digits after the decimal point, and its factor ``scale``."""

    heading: str
    digits: int
    scale: float = 1.0


_HEADLINES = {
    "pdr": _Headline("PDR", 3),
    "goodput_Bps": _Headline("Goodput [B/s]", 0),
    "latency_p50_s": _Headline("p50 [ms]", 1, 1e3),
    "latency_p95_s": _Headline("p95 [ms]", 1, 1e3),
    "latency_p99_s": _Headline("p99 [ms]", 1, 1e3),
    "age_mean_s": _Headline("Mean age [ms]", 1, 1e3),
    "path_error_m": _Headline("Path error [m]", 3),
}
"""By the names of the numbers in ``repetitions.json``."""


def repetition_grid(results: Sequence[Result]) -> Grid:
    """A section per topic, a line per number: its mean, half the width of its interval, the least and the greatest."""
    sections = (
        tuple(_line(summary, key, estimate) for key, estimate in summary.estimates.items() if estimate is not None)
        for summary in summarize(results)
    )
    title = f"{results[0].scenario}: {len(results)} runs"
    headings = ("Topic", "Number", "Mean", f"± {CONFIDENCE:.0%}", "Least", "Greatest")
    return Grid(title, headings, tuple(filter(None, sections)), texts=2)


def _line(summary: TopicSummary, key: str, estimate: Estimate) -> tuple[str, ...]:
    how = _HEADLINES[key]
    values = [value for value in summary.runs[key] if value is not None]
    reach = None if estimate.low is None or estimate.high is None else (estimate.high - estimate.low) / 2
    shown = (estimate.value, reach, min(values), max(values))
    form = f"{{:.{how.digits}f}}"
    texts = (number(None if value is None else value * how.scale, form) for value in shown)
    return (summary.topic, how.heading, *texts)
