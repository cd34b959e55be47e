"""One experiment several times: the folders of its runs, and how much its headline numbers vary.

Invariants: repetition k, from 0, is in the folder `rep-k`; the numbers are those of the runs' own results; intervals
are Student's t intervals for the mean, at 95 %, and None where fewer than two runs have the number.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gr_ros2.core.errors import ConfigError
from gr_ros2.core.files import write_text, write_whole
from gr_ros2.observe.result import TopicResult
from gr_ros2_lab.record.result import Result, topic_numbers
from gr_ros2_lab.record.statistics import CONFIDENCE, Estimate, average

REPETITIONS_FILE = "repetitions.json"

HEADLINES = (
    "pdr",
    "goodput_Bps",
    "latency_p50_s",
    "latency_p95_s",
    "latency_p99_s",
    "age_mean_s",
    "path_error_m",
)
"""The numbers that are summarized, by their names in ``topic_numbers``."""


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


def repetition_folder(out: Path, k: int) -> Path:
    """The folder of repetition k of an experiment."""
    return out / f"rep-{k}"


def run_folders(path: Path) -> list[Path]:
    """The runs in a folder: its repetitions in their order, or else the folder itself.

    :raises ConfigError: when it holds repetitions and their list is damaged
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
        runs = {key: [numbers.get(key) for numbers in found] for key in HEADLINES}
        estimates = {key: average([value for value in values if value is not None]) for key, values in runs.items()}
        summaries.append(TopicSummary(first.topic, first.src_id, runs, estimates))
    return summaries


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


def _numbers(result: Result, wanted: TopicResult) -> dict[str, Any]:
    same = (topic for topic in result.topics if (topic.topic, topic.src_id) == (wanted.topic, wanted.src_id))
    return next((topic_numbers(topic, ()) for topic in same), {})


def _as_json(summary: TopicSummary) -> dict[str, Any]:
    numbers = {
        key: None
        if estimate is None
        else {"mean": estimate.value, "low": estimate.low, "high": estimate.high, "runs": summary.runs[key]}
        for key, estimate in summary.estimates.items()
    }
    return {"topic": summary.topic, "src_id": summary.src_id, **numbers}
