"""Joins where robots are with what a link has counted, into the rows of a survey.

Invariants: no input or output, and time is an argument. A row says what was heard since the one before, at the newest
place. Packets that were lost while nobody was heard, and of which one learns only afterwards, count at the places of
that silence.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import nan
from typing import Any

from gr_ros2_lab.survey.table import SurveyRow

STALE_S = 2.0
"""s after which a place is too old to be that of a robot that drives."""
_SILENT_S = 3.0
"""s without a packet after which a robot that was forgotten counts as out of reach."""


@dataclass(frozen=True)
class Place:
    """Where a robot is.

    :param at: when it was there, s
    :param x, y: m
    :param latitude, longitude: degrees; NaN = not known
    """

    at: float
    x: float
    y: float
    latitude: float = nan
    longitude: float = nan


@dataclass(frozen=True)
class _Counts:
    """Of a robot, since the link began."""

    now: float
    uptime_s: float
    packets: int
    lost: int
    delivered: int


class SurveyRecorder:
    """See the module.

    :param robot: number of the robot that is heard; None: the first one
    :ivar base: where that robot stands, x and y in m; None: where this one set out, unless it tells its place
    :ivar rows: so far
    :ivar missed: looks that made no row, by reason
    """

    def __init__(self, robot: int | None = None) -> None:
        self.robot = robot
        self.rows: list[SurveyRow] = []
        self.missed = {"no place": 0, "old place": 0}
        self.base: tuple[float, float] | None = None
        self._here: Place | None = None
        self._there: Place | None = None
        self._before: _Counts | None = None
        self._began: float | None = None
        self._silence: list[int] = []
        """Places in ``rows`` of those since the last packet."""
        self._forgotten = False
        """Whether the link has forgotten that robot meanwhile."""

    def here(self, place: Place) -> None:
        """This robot is there."""
        self._here = place
        if self.base is None and self._there is None:
            self.base = place.x, place.y

    def there(self, place: Place) -> None:
        """The robot that is heard is there."""
        self._there = place

    def look(self, stats: Mapping[str, Any], now: float) -> SurveyRow | None:
        """Take what a link counts now; returns the row that it makes.

        :param stats: from :meth:`gr_ros2.radio.robot_link.RobotLink.stats`
        """
        counts = self._counts(stats, now)
        before, self._before = self._before, counts
        if counts is None or before is None or counts.uptime_s < before.uptime_s or counts.packets < before.packets:
            return None  # the link has begun, or begun anew
        place = self._here
        if place is None or now - place.at > STALE_S:
            self.missed["no place" if place is None else "old place"] += 1
            return None
        row = self._row(stats, place, before, counts)
        if row.packets:
            row = replace(row, lost=self._end_silence(row.lost))
        else:
            self._silence.append(len(self.rows))
        self.rows.append(row)
        return row

    def finish(self) -> list[SurveyRow]:
        """The rows that tell something, at the end."""
        self._forgotten = True  # nobody will tell what is lost since
        self._end_silence(0.0)
        return [row for row in self.rows if row.packets + row.lost > 0]

    def _end_silence(self, lost: float) -> float:
        """Somebody is heard again: give the rows of the silence their share of what was lost; returns what is left for
        the row that ends it.

        :param lost: packets, as their numbers tell, if the link remembers the last one before
        """
        silence, forgotten = self._silence, self._forgotten
        self._silence, self._forgotten = [], False
        if not silence:
            return lost
        each = lost / (len(silence) + 1)
        if forgotten:
            lasted = self.rows[silence[-1]].t_s - self.rows[silence[0]].t_s
            each, lost = self._usual() if lasted >= _SILENT_S else 0.0, 0.0
        for place in silence:
            self.rows[place] = replace(self.rows[place], lost=self.rows[place].lost + each)
        return lost if forgotten else each

    def _usual(self) -> float:
        """Packets that the robot sends between two looks."""
        heard = [row.packets + row.lost for row in self.rows if row.packets]
        return sum(heard) / len(heard) if heard else 0.0

    def _row(self, stats: Mapping[str, Any], place: Place, before: _Counts, counts: _Counts) -> SurveyRow:
        assert self.robot is not None
        if self._began is None:
            self._began = before.now
        their = (self._there.x, self._there.y) if self._there is not None else self.base or (place.x, place.y)
        peer = next((peer for peer in stats["peers"] if peer["robot"] == self.robot), None)
        snr_db = None if peer is None else peer["snr_db"]
        if snr_db is None and len(stats["peers"]) == 1:  # a PHY that does not tell it packet by packet
            snr_db = stats["phy"]["snr_db"]
        packets = counts.packets - before.packets
        ages = [topic["age_s"] for topic in self._topics(stats) if topic["age_s"] is not None]
        return SurveyRow(
            t_s=counts.now - self._began,
            robot=self.robot,
            x_m=place.x,
            y_m=place.y,
            their_x_m=their[0],
            their_y_m=their[1],
            latitude=place.latitude,
            longitude=place.longitude,
            packets=packets,
            lost=max(counts.lost - before.lost, 0),
            snr_db=nan if snr_db is None or not packets else float(snr_db),
            rate_hz=max(counts.delivered - before.delivered, 0) / max(counts.now - before.now, 1e-9),
            age_s=sum(ages) / len(ages) if ages else nan,
        )

    def _topics(self, stats: Mapping[str, Any]) -> list[Mapping[str, Any]]:
        return [topic for topic in stats["sink"]["topics"].values() if topic["src_id"] == self.robot]

    def _counts(self, stats: Mapping[str, Any], now: float) -> _Counts | None:
        peers = {peer["robot"]: peer for peer in stats["peers"]}
        if self.robot is None:
            self.robot = next(iter(peers), None)
        sink, robot = stats["sink"], self.robot
        if robot is None:
            return None
        lost = peers[robot]["lost"] if robot in peers else self._before.lost if self._before is not None else 0
        self._forgotten |= robot not in peers
        delivered = sum(topic["delivered"] for topic in self._topics(stats))
        packets = sink["packets_of"].get(robot, sink["packets_of"].get(str(robot), 0))  # JSON has text for keys
        return _Counts(now, stats["uptime_s"], packets, lost, delivered)
