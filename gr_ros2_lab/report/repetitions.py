"""The headline numbers of one experiment that was run several times, as a grid."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from gr_ros2_lab.record.repetitions import TopicSummary, summarize
from gr_ros2_lab.record.result import Result
from gr_ros2_lab.record.statistics import CONFIDENCE, Estimate, average
from gr_ros2_lab.record.team_numbers import TEAM_VALUES, team_numbers
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
_SPREAD = ("Mean", f"± {CONFIDENCE:.0%}", "Least", "Greatest")


_FIRST = ("pdr", "latency_p50_s", "latency_p99_s", "age_mean_s")
"""The numbers of each topic in a summary."""
_LINES = 8
"""Most lines of a summary."""


def repetition_summary(results: Sequence[Result]) -> Grid:
    """What matters of all runs in few lines: the numbers of a team, its task first; otherwise a line for each topic,
    of many for those of which least was delivered."""
    title = f"{results[0].scenario}: {len(results)} runs"
    if team := team_numbers(results[0]):
        ordered = [*results[0].task, *(name for name in team if name not in results[0].task)]
        found = {name: [team_numbers(result).get(name) for result in results] for name in ordered}
        lines = [
            (TEAM_VALUES.get(name, name), *(number(one, "{:.3g}") for one in _spread(values, average(values))))
            for name, numbers in found.items()
            if (values := [value for value in numbers if value is not None])
        ]
        return Grid(title, ("Number", *_SPREAD), (tuple(lines[:_LINES]),))
    whole = repetition_grid(results)
    if sum(map(len, whole.sections)) <= _LINES:
        return whole
    topics = sorted(summarize(results), key=lambda one: one.estimates["pdr"].value if one.estimates["pdr"] else 2.0)
    shown = {one.topic for one in topics[:_LINES]}
    lines = [
        (one.topic, *(_mean(_HEADLINES[key], one.estimates[key]) for key in _FIRST))
        for one in summarize(results)
        if one.topic in shown
    ]
    return Grid(
        f"{title}, ± {CONFIDENCE:.0%}", ("Topic", *(_HEADLINES[key].heading for key in _FIRST)), (tuple(lines),)
    )


def _mean(how: _Headline, estimate: Estimate | None) -> str:
    form = f"{{:.{how.digits}f}}"
    if estimate is None or estimate.low is None or estimate.high is None:
        return number(None if estimate is None else estimate.value * how.scale, form)
    reach = (estimate.high - estimate.low) / 2
    return " ± ".join(form.format(value * how.scale) for value in (estimate.value, reach))


def repetition_grid(results: Sequence[Result]) -> Grid:
    """A section per topic, a line per number: its mean, half the width of its interval, the least and the greatest."""
    sections = (
        tuple(_line(summary, key, estimate) for key, estimate in summary.estimates.items() if estimate is not None)
        for summary in summarize(results)
    )
    title = f"{results[0].scenario}: {len(results)} runs"
    return Grid(title, ("Topic", "Number", *_SPREAD), tuple(filter(None, sections)), texts=2)


def _line(summary: TopicSummary, key: str, estimate: Estimate) -> tuple[str, ...]:
    how = _HEADLINES[key]
    values = [value for value in summary.runs[key] if value is not None]
    form = f"{{:.{how.digits}f}}"
    texts = (number(None if one is None else one * how.scale, form) for one in _spread(values, estimate))
    return (summary.topic, how.heading, *texts)


def _spread(values: Sequence[float], estimate: Estimate | None) -> tuple[float | None, ...]:
    """The mean, half the width of its interval, the least and the greatest."""
    if estimate is None:
        return (None,) * len(_SPREAD)
    reach = None if estimate.low is None or estimate.high is None else (estimate.high - estimate.low) / 2
    return estimate.value, reach, min(values), max(values)
