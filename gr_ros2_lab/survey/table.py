"""The table of a survey: what a robot heard of another one, row by row, with where both were; and what it says of other
places.

Invariants: what was measured near a place counts there; farther off, the fitted path loss does. Both directions between
two places are alike. A place where packets were sent and none arrived has no SNR, and nothing is heard there.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable
from dataclasses import astuple, dataclass, fields
from functools import cached_property
from math import isnan, nan
from pathlib import Path

import numpy as np

from gr_ros2.core.arrays import Floats
from gr_ros2.core.errors import ConfigError
from gr_ros2_lab.survey.fit import DistanceFit, fit_odds, fit_over_distance
from gr_ros2_lab.survey.numbers import check_ranges, read_numbers

CELL_M = 1.0
"""Edge of the cells in which rows become one point, m."""
SPREAD_M = 2.0
"""Standard deviation of the weight of a point over its distance, m: GPS is as exact."""
_FIT_WEIGHT = 0.05
"""Weight of the fit beside the points around a place, each of weight 1 at most."""
UNHEARD_DB = -40.0
"""SNR at which nobody hears anything."""
_ENOUGH = 5
"""Packets sent without any arriving from which on a place counts as one where nothing is heard."""


@dataclass(frozen=True)
class SurveyRow:
    """What was heard in one interval.

    :param t_s: its end, s after the begin
    :param robot: number of the robot heard
    :param x_m, y_m: where this robot was
    :param their_x_m, their_y_m: where that robot was
    :param latitude, longitude: of this robot, degrees; NaN = not known
    :param packets: of that robot that arrived
    :param lost: packets of it that did not
    :param snr_db: of those that arrived; NaN = not known
    :param rate_hz: messages/s that came out
    :param age_s: mean age of its topics; NaN = not known
    """

    t_s: float
    robot: int
    x_m: float
    y_m: float
    their_x_m: float
    their_y_m: float
    latitude: float
    longitude: float
    packets: float
    lost: float
    snr_db: float
    rate_hz: float
    age_s: float

    @property
    def loss(self) -> float:
        """Share of the packets that were lost, 0..1; NaN where none was sent."""
        sent = self.packets + self.lost
        return self.lost / sent if sent else nan


COLUMNS = tuple(item.name for item in fields(SurveyRow))
NEEDED = ("x_m", "y_m", "their_x_m", "their_y_m", "packets", "lost")
_RANGES = {
    **dict.fromkeys(("x_m", "y_m", "their_x_m", "their_y_m"), (-1e9, 1e9)),
    **dict.fromkeys(("packets", "lost"), (0.0, 1e15)),
    "robot": (0.0, 255.0),
    "snr_db": (-100.0, 100.0),
}
_MAY_LACK = ("latitude", "longitude", "snr_db", "age_s")


def write_table(rows: Iterable[SurveyRow], path: Path) -> None:
    """Write rows as CSV."""
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow([*COLUMNS, "loss"])
        for row in rows:
            writer.writerow([_cell(value) for value in (*astuple(row), row.loss)])


def _cell(value: float) -> str:
    return "" if isnan(value) else f"{value:.10g}"


def read_table(path: Path) -> list[SurveyRow]:
    """The rows of a table.

    :raises ConfigError: when it cannot be read, lacks a column, or has a cell that is no finite number that can be
    """
    columns = read_numbers(path, COLUMNS, _MAY_LACK)
    if lacking := [name for name in NEEDED if name not in columns]:
        raise ConfigError(f"{path}: a survey needs the columns {', '.join(NEEDED)}; {lacking[0]} is missing")
    count = len(columns["x_m"])
    check_ranges(path, columns, _RANGES)
    whole = [columns.get(name, np.full(count, nan if name in _MAY_LACK else 0.0)).tolist() for name in COLUMNS]
    return [SurveyRow(t, int(robot), *rest) for t, robot, *rest in zip(*whole, strict=True)]


class Survey:
    """What was measured, and what follows for other places.

    :param name: of its file, in errors
    :param rows: in any order
    :raises ConfigError: when no packet was counted
    """

    def __init__(self, name: str, rows: Iterable[SurveyRow]) -> None:
        self.name = name
        table = np.array([astuple(row) for row in rows if row.packets + row.lost > 0]).reshape(-1, len(COLUMNS))
        if not len(table):
            raise ConfigError(f"{name}: counts no packet; drive where the other robot is heard")
        column = {name: table[:, place] for place, name in enumerate(COLUMNS)}
        ends = np.stack([column[end] for end in ("x_m", "y_m", "their_x_m", "their_y_m")], 1)
        _, cells = np.unique(np.round(ends / CELL_M), axis=0, return_inverse=True)
        cells, count = cells.reshape(-1), int(cells.max()) + 1

        def summed(values: Floats) -> Floats:
            return np.asarray(np.bincount(cells, values, count), float)

        self.begin = ends[0]
        """Where both robots were first: x and y of this one, then of the other, m."""
        self.ends = np.stack([summed(end) for end in ends.T], 1) / summed(np.ones(len(cells)))[:, None]
        """Where both were, m, shape (points, 4)."""
        self.packets, self.lost = summed(column["packets"]), summed(column["lost"])
        told = np.isfinite(column["snr_db"]) & (column["packets"] > 0)
        weight = np.where(told, column["packets"], 0.0)
        with np.errstate(invalid="ignore"):
            self.snr_db = summed(weight * np.where(told, column["snr_db"], 0.0)) / summed(weight)
        """dB; NaN where it is not known."""
        self.apart = np.hypot(*(self.ends[:, :2] - self.ends[:, 2:]).T)

    @property
    def has_snr(self) -> bool:
        """Whether it tells SNRs."""
        return bool(np.isfinite(self.snr_db).any())

    @property
    def loss(self) -> Floats:
        """Share of the packets that were lost at each point, 0..1."""
        return np.asarray(self.lost / (self.packets + self.lost))

    @cached_property
    def path_loss(self) -> DistanceFit:
        """The line through its SNRs.

        :raises ConfigError: when they tell none
        """
        known = np.isfinite(self.snr_db)
        return fit_over_distance(self.apart[known], self.snr_db[known], self.name)

    @cached_property
    def loss_line(self) -> DistanceFit:
        """The line through the log-odds of a packet's arrival.

        :raises ConfigError: when they tell none
        """
        return fit_odds(self.apart, self.packets, self.lost, self.name)

    def words(self) -> str:
        """The fit in words, with its error; why there is none otherwise."""
        try:
            line = self.path_loss if self.has_snr else self.loss_line
        except ConfigError as error:
            return str(error).removeprefix(f"{self.name}: ")
        farthest_m = float(self.apart.max())
        lost = f"{self.lost.sum() / (self.packets + self.lost).sum():.1%} of the packets lost"
        if not self.has_snr:
            there = 1 / (1 + np.exp(float(line.at(self.apart.max()))))
            return (
                f"{lost} at {line.points} places up to {farthest_m:.0f} m, and no SNR; by the line that fits, of which "
                f"they differ by {line.rms:.1%} rms, {there:.0%} at {farthest_m:.0f} m"
            )
        return (
            f"{lost}; path loss exponent {line.exponent:.2f} ± {2 * line.slope_error:.2f}, SNR {line.at_1_m:.1f} dB at "
            f"1 m, from {line.points} places up to {farthest_m:.0f} m, which differ from it by {line.rms:.1f} dB rms"
        )

    @cached_property
    def _odds(self) -> Floats:
        return np.asarray(np.log((self.packets + 0.5) / (self.lost + 0.5)))

    @cached_property
    def _levels(self) -> tuple[Floats, Floats]:
        """Points that tell a level, and by how much it is above the line."""
        unheard = (self.packets == 0) & (self.lost >= _ENOUGH)
        told = np.where(unheard, UNHEARD_DB, self.snr_db)
        known = np.isfinite(told)
        return self.ends[known], told[known] - self.path_loss.at(self.apart[known])

    def snr_between(self, here: Floats, there: Floats) -> Floats:
        """SNR from one place to others, dB.

        :param here: m, shape (2,)
        :param there: m, shape (n, 2)
        """
        distances = np.hypot(*(there - here).T)
        ends, above = self._levels
        return np.asarray(self.path_loss.at(distances) + _around(ends, above, here, there))

    def loss_between(self, here: Floats, there: Floats) -> float:
        """Share of the packets that are lost from one place to another, 0..1.

        :param there: m, shape (2,)
        """
        line = self.loss_line
        odds = line.at(np.array([np.hypot(*(there - here))]))
        odds = odds + _around(self.ends, self._odds - line.at(self.apart), here, there[None])
        return float(1 / (1 + np.exp(np.clip(odds[0], -50, 50))))


def _around(ends: Floats, values: Floats, here: Floats, there: Floats) -> Floats:
    """The mean of values around pairs of places, which goes to 0 far from all.

    :param ends: where both ends of each value were, m, shape (points, 4)
    """
    found = np.zeros(len(there))
    for number, other in enumerate(there):
        pair, back = np.concatenate((here, other)), np.concatenate((other, here))
        squares = np.minimum(((ends - pair) ** 2).sum(1), ((ends - back) ** 2).sum(1))
        weights = np.exp(-squares / (2 * SPREAD_M**2))
        found[number] = (weights * values).sum() / (weights.sum() + _FIT_WEIGHT)
    return found
