"""Adaptive rate: which MCS of a table of modulations and codes each packet is sent with.

Receivers report the SNR of the packets that they hear. An MCS's model says what share of its packets arrive at an SNR,
so the MCS with the greatest expected goodput can be chosen. The SNR to count on is the reported one, less two things:

- what it may have fallen since: as much as it changes on average in that time;
- a correction ("outer loop"). Reports also tell the share of packets lost. Where it is greater than expected, the model
  does not fit the radio, or reports come too late for the channel.

Invariants: a packet for several robots is sent with an MCS that suits the weakest of them; losses of packets that were
not for a robot say nothing of it; a packet for nobody who is known, and one for a robot that has fallen silent, is sent
with the most robust MCS. A slower MCS is taken at once, a faster one at a report. There is no clock here: ``now`` is
seconds, monotonic.

``python -m bench rate_rules`` measures each rule and constant: on some channel each rule gains 3 % or more.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from math import exp, inf

from gr_ros2.core.errors import ConfigError
from gr_ros2.core.tuning import Tuning

_STEEPEST = 50.0
"""Largest exponent of the odds; beyond it the share that arrives is 0 or 1."""


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

    tuning: Tuning
    mcs: int = 0
    reported_db: float = -inf
    """The newest SNR reported."""
    heard: float = -inf
    """When it was reported, s."""
    gap_s: float = field(init=False)
    """Usual time between two reports."""
    unanswered: int = 0
    correction_db: float = 0.0
    before: tuple[float, float] = (-inf, 0.0)
    """When the SNR was looked at for its change, s, and its value then, dB."""
    change_db_s: float = 0.0
    """How fast the SNR changes on average, up or down, dB/s: 0 for a constant channel."""

    def __post_init__(self) -> None:
        self.gap_s = self.longest_gap_s

    @property
    def longest_gap_s(self) -> float:
        """Longest time between two reports that counts."""
        return self.tuning.rate_most_silent_s / self.tuning.rate_gaps

    def report(self, snr_db: float, now: float) -> float:
        """A report came. Returns the s since the one before, at most ``longest_gap_s``."""
        tuning, longest = self.tuning, self.longest_gap_s
        gap = min(max(now - self.heard, 0.0), longest)
        self.gap_s += tuning.rate_smoothing * (gap - self.gap_s)
        self.reported_db, self.heard, self.unanswered = snr_db, now, 0
        at, before_db = self.before
        if now - at >= tuning.rate_look_back_s:
            change = abs(snr_db - before_db) if now - at < longest else 0.0
            speed = max(change - tuning.rate_error_db, 0.0) / (now - at)
            self.change_db_s += tuning.rate_smoothing * (speed - self.change_db_s)
            self.before = now, snr_db
        return gap

    def snr_db(self, now: float) -> float:
        """The SNR to count on; -inf before the first report."""
        if self.heard == -inf:
            return -inf
        return self.reported_db - self.correction_db - self.change_db_s * max(now - self.heard, 0.0)

    def silent(self, now: float) -> bool:
        """Whether no report has come though it should have."""
        waited = now - self.heard
        tuning = self.tuning
        return waited > tuning.rate_most_silent_s or (
            self.unanswered >= tuning.rate_unanswered
            and waited > max(tuning.rate_gaps * self.gap_s, tuning.rate_least_silent_s)
        )


class RateController:
    """Chooses the MCS of each packet.

    :param mcs_table: the rates, the most robust one first, each faster than the one before
    :raises ConfigError: for a table without an MCS, or in another order
    """

    def __init__(self, mcs_table: Sequence[Mcs], tuning: Tuning) -> None:
        self._tuning = tuning
        if not mcs_table or any(one.airtime_s <= two.airtime_s for one, two in pairwise(mcs_table)):
            raise ConfigError("the MCS table: one MCS at least, each with less airtime than the one before")
        self.mcs_table = tuple(mcs_table)
        self._robots: dict[int, _Peer] = {}

    def report(self, robot: int, snr_db: float, loss: float, now: float, *, not_for: float = 0.0) -> None:
        """A robot has reported.

        :param snr_db: of the newest packets that it has heard
        :param loss: share of the packets that it has lost lately, 0..1
        :param not_for: share of the packets that it should have lost because they were sent faster than it hears
        """
        known = self._robots.setdefault(robot, _Peer(self._tuning))
        gap = known.report(snr_db, now)
        surplus = loss - not_for - (1 - not_for) * (1 - self.mcs_table[known.mcs].pdr(known.snr_db(now)))
        grows = self._tuning.rate_correction_db_s * surplus - known.correction_db / self._tuning.rate_forget_s
        known.correction_db += gap * grows
        self._choose(known, now, faster=True)

    def meet(self, robot: int) -> None:
        """A robot that can report is known. It counts for packets to everybody from now on."""
        self._robots[robot] = _Peer(self._tuning)

    def forget(self, robot: int) -> None:
        """A robot is gone."""
        self._robots.pop(robot, None)

    def chosen(self, now: float) -> dict[int, int]:
        """The index of the MCS of a packet for each robot alone."""
        return {robot: self._next(known, now) for robot, known in self._robots.items()}

    def lost(self, robot: int, mcs: int, now: float) -> float:
        """Share of the packets of an MCS that a robot is expected to lose."""
        return 1 - self.mcs_table[mcs].pdr(self._known(robot).snr_db(now))

    def sent(self, robots: Collection[int] | None, now: float) -> int:
        """A packet leaves for some robots, or for everybody (None). Returns the index of its MCS."""
        known = self._robots.values() if robots is None else [self._known(robot) for robot in robots]
        for one in known:
            one.unanswered += 1
        return min((self._next(one, now) for one in known), default=0)

    def _known(self, robot: int) -> _Peer:
        """What is known of a robot, nothing before it is met."""
        return self._robots.get(robot) or _Peer(self._tuning)

    def _next(self, known: _Peer, now: float) -> int:
        if known.silent(now):
            known.mcs = 0
        else:
            self._choose(known, now, faster=False)
        return known.mcs

    def _choose(self, known: _Peer, now: float, *, faster: bool) -> None:
        """Take the MCS that promises most.

        :param faster: whether it may be a faster one
        """
        snr_db = known.snr_db(now)
        worth = [mcs.goodput(snr_db) for mcs in (self.mcs_table if faster else self.mcs_table[: known.mcs + 1])]
        best = max(range(len(worth)), key=worth.__getitem__)
        if worth[best] > self._tuning.rate_gain * worth[known.mcs]:
            known.mcs = best
