"""Robots on one channel at one moment: what was sent and what became of it, who hears whom, and where each believes the
others to be.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

STRIP_S = 2.0
"""s of the channel that are shown packet by packet."""


@dataclass(eq=False)
class Send:
    """A packet on the air.

    :param t: s, when its burst began
    :param airtime_s: s that it lasts
    :param kind: what it was for, see :data:`gr_ros2.link.events.AirKind`
    :param heard: robots that received it
    :param overlapped: another robot sent meanwhile
    """

    t: float
    robot: int
    airtime_s: float
    kind: str
    heard: int = 0
    overlapped: bool = False

    def outcome(self, robots: int) -> str:
        """What became of it among so many robots: ``overlapped``, ``relayed``, ``heard by all`` or ``not by all``."""
        if self.overlapped:
            return "overlapped"
        if self.kind == "relay":
            return "relayed"
        return "heard by all" if self.heard >= robots - 1 else "not by all"


@dataclass(frozen=True)
class PairView:
    """Who hears whom now: share of the other's packets of the last seconds that came, and their SNR in dB; and how
    many robots sent its newest message of the last seconds on, the last of them ``over``."""

    share: float | None
    snr_db: float | None
    hops: int = 0
    over: int | None = None


@dataclass(frozen=True)
class TeamView:
    """The team at one moment.

    :param sends: the newest packets, in the order of time
    :param pairs: by receiver and sender
    :param places: where each robot says it is, m
    :param beliefs: by robot and the one that it believes to be there, m
    """

    now: float
    robots: tuple[int, ...]
    sends: tuple[Send, ...]
    pairs: Mapping[tuple[int, int], PairView]
    places: Mapping[int, tuple[float, float]]
    beliefs: Mapping[tuple[int, int], tuple[float, float]]
