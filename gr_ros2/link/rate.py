"""Adaptive rate: which MCS of a table of modulations and codes each packet is sent with.

Receivers report the SNR of the packets that they hear. An MCS's model says what share of its packets arrive at an SNR,
so the MCS with the greatest expected goodput can be chosen. Reports also tell the share of packets lost. Where it
differs from the expected share, the SNR is corrected ("outer loop": the model may not fit a radio, and in a fading
channel a report is late).

Invariants: a packet for several robots is sent with an MCS that suits the weakest of them; a packet for nobody who is
known, and one for a robot that has fallen silent, is sent with the most robust MCS. An MCS is left for a faster one
only if that promises clearly more, and only some reports after the last change: more of them each time that the faster
one is soon left again. There is no clock here: ``now`` is seconds, monotonic.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import exp, inf

from gr_ros2.core.errors import ConfigError

GAIN_UP, GAIN_DOWN = 1.1, 1.03
"""How many times the present MCS's goodput a faster MCS, and a slower one, must promise to be taken."""
SETTLED = 2
"""Reports after a change before a faster MCS is tried. A slower one is taken at once."""
_HASTY, _MOST_PATIENCE = 4, 128
"""A faster MCS that is left within this many times the reports that were waited for before it, was taken because of an
error of measurement: the next one is tried after twice as many reports, up to the second number. Otherwise after half
as many."""
MOST_SILENT_S = 1.0
"""s after which the SNR of a report is not trusted any more."""
_LEAST_SILENT_S = 0.05
_GAPS = 4.0
"""Usual times between two reports after which a robot that is sent packets counts as silent."""
_UNANSWERED = 12
"""Packets to a robot since its last report, from which on its silence means something."""
_FADING_SILENT_S, _FADING_UNANSWERED = 0.02, 4
"""The same two where the channel changes all the time, and receivers therefore report often."""
_LONGEST_GAP_S = 0.2
_SMOOTHING = 0.25
"""Share of a new report in the average of the time between reports."""
_LOOK_BACK_S = 0.02
"""s over which the change of the SNR is measured: long against the errors of single reports."""
_REPORT_S = 0.01
"""s for which the SNR of a report is old when it comes: measured on several packets, waited, and was on the air."""
_ERROR_DB = 1.0
"""Change of the SNR within this time that may be an error of measurement, dB."""
_CHANGE_DB = 1.5
"""Change of the SNR that is no error of measurement, dB."""
_DRIFT_SMOOTHING = 0.125
_MOST_DRIFT_DB_S = 150.0
_CALM_DB_S = 5.0
"""Mean rate of change up to which the channel counts as constant, dB/s."""
_CORRECTION_DB_S = 3.0
"""dB of correction per s, for a loss of 1 where 0 was expected."""
_FADE_S = 1.2
"""s in which the correction falls to 1/e: the SNR is trusted again in the end. With the speed above it limits the
correction to 3.6 dB."""
_STEEPEST = 50.0


@dataclass(frozen=True)
class Mcs:
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
class _Peer:
    """What is known of a receiver."""

    mcs: int = 0
    reported_db: float = -inf
    """The newest SNR reported."""
    correction_db: float = 0.0
    heard: float = -inf
    gap_s: float = _LONGEST_GAP_S
    unanswered: int = 0
    reports: int = 0
    """Reports since the last change of the MCS."""
    patience: int = SETTLED
    """Reports after a change before a faster MCS is tried."""
    changed_db: float = -inf
    """The SNR to count on at the last change of the MCS."""
    climbed: bool = False
    """Whether the last change was to a faster MCS."""
    before: tuple[float, float] = (-inf, 0.0)
    """When the SNR was looked at for its change, s, and its value then, dB."""
    trend_db_s: float = 0.0
    """Recent change of the SNR, dB/s."""
    drift_db_s: float = 0.0
    """Mean magnitude of this change, dB/s: 0 for a constant channel."""

    def heard_at(self, snr_db: float, now: float) -> float:
        """A report came. Returns the s since the one before."""
        gap = min(max(now - self.heard, 0.0), _LONGEST_GAP_S)
        self.gap_s += _SMOOTHING * (gap - self.gap_s)
        self.reported_db, self.heard, self.unanswered = snr_db, now, 0
        self.reports += 1
        at, snr_before_db = self.before
        if now - at >= _LOOK_BACK_S:
            change = snr_db - snr_before_db if now - at < _LONGEST_GAP_S else 0.0
            beyond = max(abs(change) - _ERROR_DB, 0.0)
            limit = min(beyond / (now - at), _MOST_DRIFT_DB_S)
            self.trend_db_s = limit if change > 0 else -limit
            self.drift_db_s += _DRIFT_SMOOTHING * (limit - self.drift_db_s)
            self.before = now, snr_db
        return gap

    def snr_db(self, now: float) -> float:
        """The SNR to count on: as it was when it was reported, less what it may have fallen since."""
        falling = max(-self.trend_db_s, self.drift_db_s)
        reported_db = self.reported_db + _REPORT_S * self.trend_db_s
        return reported_db - self.correction_db - falling * max(now - self.heard, 0.0)

    @property
    def fades(self) -> bool:
        """Whether the channel changes all the time."""
        return self.drift_db_s > _CALM_DB_S


class RateController:
    """Chooses the MCS of each packet.

    :param mcs_table: the rates, the most robust one first, each faster than the one before
    :raises ConfigError: for a table without an MCS, or in another order
    """

    def __init__(self, mcs_table: Sequence[Mcs]) -> None:
        if not mcs_table or any(one.airtime_s <= two.airtime_s for one, two in pairwise(mcs_table)):
            raise ConfigError("the MCS table: one MCS at least, each with less airtime than the one before")
        self.mcs_table = tuple(mcs_table)
        self._robots: dict[int, _Peer] = {}

    def report(self, robot: int, snr_db: float, loss: float, now: float) -> None:
        """A robot has reported.

        :param snr_db: of the newest packets that it has heard
        :param loss: share of the packets that it has lost lately, 0..1
        """
        known = self._robots.setdefault(robot, _Peer())
        gap = known.heard_at(snr_db, now)
        surplus = loss - (1 - self.mcs_table[known.mcs].pdr(known.snr_db(now)))
        known.correction_db += gap * (_CORRECTION_DB_S * surplus - known.correction_db / _FADE_S)
        self._choose(known, now)

    def meet(self, robot: int) -> None:
        """A robot that can report is known. It counts for packets to everybody from now on."""
        self._robots[robot] = _Peer()

    def forget(self, robot: int) -> None:
        """A robot is gone."""
        self._robots.pop(robot, None)

    def sent(self, robot: int | None, now: float) -> int:
        """A packet leaves for a robot, or for everybody (None). Returns the index of its MCS."""
        known = self._robots.values() if robot is None else [self._robots.get(robot, _Peer())]
        return min((self._next(one, now) for one in known), default=0)

    def _next(self, known: _Peer, now: float) -> int:
        known.unanswered += 1
        if self._silent(known, now):
            known.mcs, known.reports, known.climbed, known.changed_db = 0, 0, False, -inf
        elif known.fades:
            self._choose(known, now, faster=False)
        return known.mcs

    def _silent(self, known: _Peer, now: float) -> bool:
        waited = now - known.heard
        least_s, packets = (_FADING_SILENT_S, _FADING_UNANSWERED) if known.fades else (_LEAST_SILENT_S, _UNANSWERED)
        usual = max(_GAPS * known.gap_s, least_s)
        return waited > MOST_SILENT_S or (known.unanswered >= packets and waited > usual)

    def _choose(self, known: _Peer, now: float, *, faster: bool = True) -> None:
        snr_db = known.snr_db(now)
        worth = [mcs.goodput(snr_db) for mcs in (self.mcs_table if faster else self.mcs_table[: known.mcs + 1])]
        best = max(range(len(worth)), key=worth.__getitem__)
        gain = GAIN_UP if best > known.mcs else GAIN_DOWN
        if best == known.mcs or worth[best] < gain * worth[known.mcs]:
            return
        # A change of the SNR explains that an MCS is left. Without one, its choice was an error of measurement.
        changed = abs(snr_db - known.changed_db) > _CHANGE_DB
        if best > known.mcs:
            if not changed and known.reports < known.patience:
                return
        elif known.climbed and not changed:
            hasty = known.reports <= _HASTY * known.patience
            known.patience = min(2 * known.patience, _MOST_PATIENCE) if hasty else max(known.patience // 2, SETTLED)
        known.climbed = best > known.mcs
        known.mcs, known.reports, known.changed_db = best, 0, snr_db
