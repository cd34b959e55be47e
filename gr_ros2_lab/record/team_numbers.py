"""What a run of robots on one channel says of all of them together.

Invariant: a number follows from the result of the run alone, so a table of another run can be made at any time; a
number that does not apply is None.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable
from typing import Any

from gr_ros2.observe.result import TopicResult
from gr_ros2_lab.record.result import Result, relayed

TEAM_VALUES = {
    "pair_pdr": "PDR over all pairs",
    "pair_age_mean_s": "mean age over all pairs [s]",
    "pair_age_peak_s": "peak age of any pair [s]",
    "pairs_unheard": "pairs over which nothing came",
    "relayed": "share of the delivered messages that came over other robots",
    "jain": "Jain's index of the robots' delivered messages",
    "air_use": "airtime of all packets over the time from the first to the last",
    "formation_error_m": "formation error [m]",
    "time_to_meet_s": "time to meet [s]",
    "met": "share of runs that met",
}
"""Numbers of a team: column of a table -> label. The last three are those of tasks (``gr_ros2_lab/sim/tasks.py``)."""


def team_numbers(result: Result) -> dict[str, float | None]:
    """The numbers of ``TEAM_VALUES``; {} for a run whose robots do not all send and receive.

    A pair is a robot and a topic of another one that it could hear. Its age begins with its first delivery.
    """
    robots = [{**result.config, **robot} for robot in result.config.get("robots", ())]
    if not robots or not all(robot.get("topics") and robot.get("direction") == "both" for robot in robots):
        return {}
    pairs = team_pairs(result)
    ages = [topic.age_s.mean for topic in pairs if topic.age_s.mean is not None]
    peaks = [topic.age_s.peak for topic in pairs if topic.age_s.peak is not None]
    each: Counter[int] = Counter()
    for topic in pairs:
        each[topic.src_id] += topic.delivered
    sent = sum(topic.sent for topic in pairs)
    span = air_span_s(result)
    airtimes = {src_id: sum(kinds.values()) for src_id, kinds in airtime_of_senders(result).items()}
    return {
        "pair_pdr": each.total() / sent if sent else None,
        "pair_age_mean_s": sum(ages) / len(ages) if ages else None,
        "pair_age_peak_s": max(peaks, default=None),
        "pairs_unheard": float(sum(not topic.delivered for topic in pairs)),
        "relayed": sum(map(relayed, pairs)) / each.total() if each.total() else None,
        "jain": jain(each.values()),
        "air_use": sum(airtimes.values()) / span if airtimes and span else None,
        **result.task,
    }


def team_pairs(result: Result) -> list[TopicResult]:
    """The pairs of a robot and a topic of another one, on which something was sent."""
    ends = [result.topics, *(receiver.topics for receiver in result.receivers)]
    return [topic for topics in ends for topic in topics if topic.sent]


def ledger_of(pairs: Iterable[TopicResult]) -> Counter[str]:
    """Fate -> messages, over all of these topics."""
    ledger: Counter[str] = Counter()
    for topic in pairs:
        ledger.update(topic.ledger)
    return ledger


def jain(counts: Collection[int]) -> float | None:
    """Jain's index of fairness: 1 where all counts are equal, 1 / n where one of n has all; None where all are 0."""
    squares = len(counts) * sum(count * count for count in counts)
    return sum(counts) ** 2 / squares if squares else None


def airtime_of_senders(result: Result) -> dict[str, dict[str, float]]:
    """s of airtime by source id and kind of packet, of every robot that any receiver of the run could hear."""
    return {src_id: kinds for phy in _phys(result) for src_id, kinds in (phy.get("airtime_of_senders_s") or {}).items()}


def air_span_s(result: Result) -> float:
    """s from the first packet that any receiver of the run could hear to the end of the last one; 0 for none."""
    return max(phy.get("air_span_s") or 0.0 for phy in _phys(result))


def _phys(result: Result) -> list[dict[str, Any]]:
    return [result.phy, *(receiver.phy for receiver in result.receivers)]
