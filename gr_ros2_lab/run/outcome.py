"""What a run returns and what it reports while it runs, in real time and in simulated time alike.

Invariant: nothing here depends on how a run is made.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from gr_ros2.phy import Phy
from gr_ros2.phy.theory import half_point
from gr_ros2_lab.record.recorder import Recorder
from gr_ros2_lab.record.result import Result
from gr_ros2_lab.record.team import TeamRecord
from gr_ros2_lab.record.trace import Trace

DELIVERED_BAG = "delivered"
"""Folder of the bag with the messages that were published on the receiving graphs."""


@dataclass(frozen=True)
class Progress:
    """Progress of a run.

    :param elapsed_s: s since its start
    :param duration_s: s that it takes, 0 = until the bag ends
    :param graphs: the ROS graphs of the run: what they are, and their domains; None where others cannot join one
    """

    elapsed_s: float
    duration_s: float
    sent: int
    delivered: int
    graphs: tuple[tuple[str, int | None], ...] = ()


@dataclass
class Outcome:
    """The result, the trace of every message, and where robots share a channel what all of them saw."""

    result: Result
    trace: Trace
    team: TeamRecord | None = None


def by_sender(counted: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Counters as in a result: those of the first robot, of a second as ``back``, of several others as ``robots``.

    :param counted: of each robot that sends
    """
    first, *others = counted
    rest = {"back": others[0]} if len(others) == 1 else {"robots": others} if others else {}
    return {**first, **rest}


def phy_numbers(phy: Phy, channels: int, recorder: Recorder) -> dict[str, Any]:
    """The field ``phy`` of a result. Call it after the recorder has finished.

    :param channels: how many the robots used
    """
    return {
        "name": phy.name,
        "channels": channels,
        "sample_rate": phy.sample_rate if phy.has_samples else None,
        "runs_on": phy.runs_on(),
        "airtime_samples": phy.airtime_samples() if phy.has_samples else None,
        "half_snr_db": round(half_point(phy.computed_pdr), 1) if phy.has_samples else None,
        **recorder.airtime(phy.airtime if phy.has_airtime else None),
    }
