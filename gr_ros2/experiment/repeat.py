"""One experiment several times, with other seeds each time, and how far its headline numbers vary.

Laws: repetition k, from 0, is the same scenario with every seed k higher, in the folder `rep-k`; the numbers are those
of the runs' own results; intervals are Student's for the mean, at 95 %, and None where fewer than two runs have the
number.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from gr_ros2.config import ChannelConfig, replaced
from gr_ros2.errors import ConfigError
from gr_ros2.experiment.result import Result, TopicResult, topic_numbers
from gr_ros2.experiment.scenario import Scenario
from gr_ros2.experiment.sweep.statistics import CONFIDENCE, Estimate, average
from gr_ros2.experiment.table import Grid, number
from gr_ros2.experiment.trace import write_text, write_whole

REPETITIONS_FILE = "repetitions.json"


@dataclass(frozen=True)
class _Headline:
    """How a number of a topic is shown: its heading, with so many digits, in units of 1 / scale."""

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
"""By their names in the tables of a report."""


@dataclass(frozen=True)
class TopicSummary:
    """The headline numbers of one topic over all runs.

    :param runs: number -> its value in each run, None where a run has none
    :param estimates: number -> its mean and interval, None where no run has it
    """

    topic: str
    src_id: int
    runs: dict[str, list[float | None]]
    estimates: dict[str, Estimate | None]


def repetitions(scenario: Scenario) -> Iterator[Scenario]:
    """The scenario once per repetition, each with its own seeds."""
    for k in range(scenario.repetitions):
        yield replace(_reseeded(scenario, k), repetitions=1)


def repetition_folder(out: Path, k: int) -> Path:
    """Where repetition k of an experiment lies."""
    return out / f"rep-{k}"


def run_folders(path: Path) -> list[Path]:
    """The runs in a folder: its repetitions in their order, or else the folder itself.

    :raises ConfigError: when it holds repetitions, and the list of them is damaged
    """
    listed = path / REPETITIONS_FILE
    if not listed.is_file():
        return [path]
    try:
        seeds = json.loads(listed.read_bytes())["seeds"]
        return [repetition_folder(path, k) for k in range(len(seeds))]
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise ConfigError(
            f"{listed}: damaged or half-written, no list of repetitions; run the experiment again"
        ) from error


def summarize(results: Sequence[Result]) -> list[TopicSummary]:
    """Every topic's headline numbers, in the order of the first result.

    :param results: of the repetitions of one scenario
    """
    summaries = []
    for first in results[0].topics:
        found = [_numbers(result, first) for result in results]
        runs = {key: [numbers.get(key) for numbers in found] for key in _HEADLINES}
        estimates = {key: average([value for value in values if value is not None]) for key, values in runs.items()}
        summaries.append(TopicSummary(first.topic, first.src_id, runs, estimates))
    return summaries


def repetition_grid(results: Sequence[Result]) -> Grid:
    """A section per topic, a line per number: its mean, half the width of its interval, the least and the greatest."""
    sections = (
        tuple(_line(summary, key, estimate) for key, estimate in summary.estimates.items() if estimate is not None)
        for summary in summarize(results)
    )
    title = f"{results[0].scenario}: {len(results)} runs"
    headings = ("Topic", "Number", "Mean", f"± {CONFIDENCE:.0%}", "Least", "Greatest")
    return Grid(title, headings, tuple(filter(None, sections)), texts=2)


def write_repetitions(results: Sequence[Result], out: Path) -> Path:
    """Write ``repetitions.json``: every topic's headline numbers, their means and intervals.

    :raises ConfigError: when it cannot be written
    """
    values = {
        "scenario": results[0].scenario,
        "seeds": [result.seed for result in results],
        "confidence": CONFIDENCE,
        "topics": [_as_json(summary) for summary in summarize(results)],
    }
    text = json.dumps(values, indent=2, allow_nan=False) + "\n"
    return write_whole(out / REPETITIONS_FILE, text, write_text)


def _reseeded(scenario: Scenario, k: int) -> Scenario:
    """The same with every seed so much higher."""
    sim, channel = replaced(scenario.sim, seed=scenario.sim.seed + k), _reseeded_channel(scenario.channel, k)
    back = scenario.back and replace(scenario.back, channel=_reseeded_channel(scenario.back.channel, k))
    return replace(scenario, seed=scenario.seed + k, sim=sim, channel=channel, back=back)


def _reseeded_channel(channel: ChannelConfig, k: int) -> ChannelConfig:
    return replaced(channel, seed=channel.seed + k)


def _numbers(result: Result, wanted: TopicResult) -> dict[str, Any]:
    """The numbers of one topic of one source, {} where this result has no such topic."""
    same = (topic for topic in result.topics if (topic.topic, topic.src_id) == (wanted.topic, wanted.src_id))
    return next((topic_numbers(topic, ()) for topic in same), {})


def _line(summary: TopicSummary, key: str, estimate: Estimate) -> tuple[str, ...]:
    how = _HEADLINES[key]
    values = [value for value in summary.runs[key] if value is not None]
    reach = None if estimate.low is None or estimate.high is None else (estimate.high - estimate.low) / 2
    shown = (estimate.value, reach, min(values), max(values))
    form = f"{{:.{how.digits}f}}"
    texts = (number(None if value is None else value * how.scale, form) for value in shown)
    return (summary.topic, how.heading, *texts)


def _as_json(summary: TopicSummary) -> dict[str, Any]:
    numbers = {
        key: None
        if estimate is None
        else {"mean": estimate.value, "low": estimate.low, "high": estimate.high, "runs": summary.runs[key]}
        for key, estimate in summary.estimates.items()
    }
    return {"topic": summary.topic, "src_id": summary.src_id, **numbers}
