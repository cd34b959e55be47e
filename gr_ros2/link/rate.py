"""Adaptive rate: which rung of a ladder of modulations and codes each packet is sent with.

Receivers report the SNR of the packets that they hear. A rung's model says what share of its packets arrive at an SNR,
so the rung with the greatest expected goodput can be chosen. Reports also tell the share of packets lost. Where it
differs from the expected share, the SNR is corrected ("outer loop": the model may not fit a radio, and in a fading
channel a report is late).

Invariants: a packet for several robots is sent with a rung that suits the weakest of them; a packet for nobody who is
known, and one for a robot that has fallen silent, is sent with the most robust rung. A rung is left for a faster one
only if that promises clearly more, and only some reports after the last change: more of them each time that the faster
one is soon left again. There is no clock here: ``now`` is seconds, monotonic.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import exp, inf

from gr_ros2.errors import ConfigError

GAIN_UP, GAIN_DOWN = 1.1, 1.03
"""How many times the present rung's goodput a faster rung, and a slower one, must promise to be taken."""
SETTLED = 2
"""Reports after a change before a faster rung is tried. A slower one is taken at once."""
_HASTY, _MOST_PATIENCE = 4, 128
"""A faster rung that is left within this many times the reports that were waited for before it, was taken because of an
error of measurement: the next one is tried after twice as many reports, up to the second number. Otherwise after half
as many."""
MOST_SILENT_S = 1.0
"""s after which the SNR of a report is not trusted any more."""
_LEAST_SILENT_S = 0.05
_GAPS = 4.0
"""Usual times between two reports after which a robot that is sent packets counts as silent."""
_UNANSWERED = 12
"""Packets to a robot since its last report, from which on its silence means something."""
_LONGEST_GAP_S = 0.2
_SMOOTHING = 0.25
"""Share of a new report in the averages of SNR and time between reports."""
_STEP_DB = 1.5
"""Change of the SNR from one report to the next that is believed at once, dB."""
_CORRECTION_DB = 0.1
"""dB of correction per report, for a loss of 1 where 0 was expected."""
_MOST_CORRECTION_DB = 6.0
_FADE = 0.97
"""Share of the correction that is kept with each report: the SNR is trusted again in the end."""
_STEEPEST = 50.0


@dataclass(frozen=True)
class Rung:
    """A modulation and a code.

    :param name: for people
    :param airtime_s: s that the longest packet is on the air
    :param half_db: SNR at which half of these packets arrive, dB
    :param width_db: dB above it at which the odds of arriving are e to 1
    """

    name: str
    airtime_s: float
    half_db: float
    width_db: float

    def pdr(self, snr_db: float) -> float:
        """Expected share of the longest packets that arrive, 0..1."""
        odds = (snr_db - self.half_db) / self.width_db
        return 1 / (1 + exp(min(-odds, _STEEPEST)))

    def goodput(self, snr_db: float) -> float:
        """Expected number of the longest packets that arrive in a second."""
        return self.pdr(snr_db) / self.airtime_s


@dataclass
class _Robot:
    """What is known of a receiver."""

    rung: int = 0
    mean_db: float = -inf
    """SNR, averaged over the newest reports."""
    correction_db: float = 0.0
    heard: float = -inf
    gap_s: float = _LONGEST_GAP_S
    unanswered: int = 0
    reports: int = 0
    """Reports since the last change of the rung."""
    patience: int = SETTLED
    """Reports after a change before a faster rung is tried."""
    climbed: bool = False
    """Whether the last change was to a faster rung."""

    @property
    def snr_db(self) -> float:
        """The SNR to count on."""
        return self.mean_db - self.correction_db


class RateController:
    """Chooses the rung of each packet.

    :param ladder: the rungs, the most robust one first, each faster than the one before
    :raises ConfigError: for a ladder without rungs, or in another order
    """

    def __init__(self, ladder: Sequence[Rung]) -> None:
        if not ladder or any(one.airtime_s <= two.airtime_s for one, two in pairwise(ladder)):
            raise ConfigError("the rungs of a ladder: one at least, each with less airtime than the one before")
        self.ladder = tuple(ladder)
        self._robots: dict[int, _Robot] = {}

    def report(self, robot: int, snr_db: float, loss: float, now: float) -> None:
        """A robot has reported.

        :param snr_db: of the newest packets that it has heard
        :param loss: share of the packets that it has lost lately, 0..1
        """
        known = self._robots.setdefault(robot, _Robot())
        gap = min(max(now - known.heard, 0.0), _LONGEST_GAP_S)
        known.gap_s += _SMOOTHING * (gap - known.gap_s)
        known.heard, known.unanswered = now, 0
        # A small difference is an error of measurement, a large one a change of the channel.
        if abs(snr_db - known.mean_db) > _STEP_DB:
            known.mean_db = snr_db
        known.mean_db += _SMOOTHING * (snr_db - known.mean_db)
        known.reports += 1
        surplus = loss - (1 - self.ladder[known.rung].pdr(known.snr_db))
        correction = _FADE * known.correction_db + _CORRECTION_DB * surplus
        known.correction_db = min(max(correction, -_MOST_CORRECTION_DB), _MOST_CORRECTION_DB)
        self._choose(known)

    def meet(self, robot: int) -> None:
        """A robot that can report is known. It counts for packets to everybody from now on."""
        self._robots[robot] = _Robot()

    def forget(self, robot: int) -> None:
        """A robot is gone."""
        self._robots.pop(robot, None)

    def sent(self, robot: int | None, now: float) -> int:
        """A packet leaves for a robot, or for everybody (None). Returns the index of its rung."""
        known = self._robots.values() if robot is None else [self._robots.get(robot, _Robot())]
        return min((self._next(one, now) for one in known), default=0)

    def _next(self, known: _Robot, now: float) -> int:
        known.unanswered += 1
        if self._silent(known, now):
            known.rung, known.reports, known.climbed = 0, 0, False
        return known.rung

    def _silent(self, known: _Robot, now: float) -> bool:
        waited = now - known.heard
        usual = max(_GAPS * known.gap_s, _LEAST_SILENT_S)
        return waited > MOST_SILENT_S or (known.unanswered >= _UNANSWERED and waited > usual)

    def _choose(self, known: _Robot) -> None:
        worth = [rung.goodput(known.snr_db) for rung in self.ladder]
        best = max(range(len(worth)), key=worth.__getitem__)
        gain = GAIN_UP if best > known.rung else GAIN_DOWN
        if best == known.rung or worth[best] < gain * worth[known.rung]:
            return
        if best > known.rung:
            if known.reports < known.patience:
                return
        elif known.climbed:
            hasty = known.reports <= _HASTY * known.patience
            known.patience = min(2 * known.patience, _MOST_PATIENCE) if hasty else max(known.patience // 2, SETTLED)
        known.climbed = best > known.rung
        known.rung, known.reports = best, 0
