"""The straight line over the logarithm of the distance that fits what was measured, and how far to trust it."""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt

import numpy as np

from gr_ros2.core.arrays import Floats
from gr_ros2.core.errors import ConfigError

NEAR_M = 1.0
"""Distance from which on the line holds; nearer ends count as this far apart."""
_STEPS, _FLAT = 60, 1e-9
"""Of Newton's method, each of 1 at most, and what keeps it from dividing by nothing."""
_LEAST_POINTS, _LEAST_RATIO = 5, 1.5
"""Fewest points of a fit, and the least ratio of the farthest distance to the nearest."""


@dataclass(frozen=True)
class DistanceFit:
    """``at_1_m + slope * 10 log10(distance)``. Of an SNR the slope is minus the exponent of the path loss.

    :param slope_error: standard deviation of the slope, where the points are independent
    :param rms: what is left, as a root of the mean square; of odds, of the shares that they stand for
    :param points: how many there were
    """

    at_1_m: float
    slope: float
    slope_error: float
    rms: float
    points: int

    def at(self, distances: Floats) -> Floats:
        """The value at distances in m."""
        return np.asarray(self.at_1_m + self.slope * _decades(distances))

    @property
    def exponent(self) -> float:
        """Of the path loss, where the value is a level in dB."""
        return -self.slope

    def range_m(self, value: float) -> float:
        """Distance at which a falling line reaches a value, m."""
        return float(max(NEAR_M, 10 ** min((self.at_1_m - value) / (10 * max(self.exponent, 0.1)), 9.0)))


def fit_over_distance(distances: Floats, values: Floats, what: str) -> DistanceFit:
    """The line through points, by least squares.

    :param distances: m
    :param what: names the points in errors
    :raises ConfigError: for points that tell no slope
    """
    along = _told(distances, what)
    count = len(distances)
    middle = along.mean()
    spread = float(((along - middle) ** 2).sum())
    slope = float(((along - middle) * values).sum()) / spread
    at_1_m = float(values.mean() - slope * middle)
    left = values - at_1_m - slope * along
    squares = float((left**2).sum())
    return DistanceFit(at_1_m, slope, sqrt(squares / (count - 2) / spread), sqrt(squares / count), count)


def fit_odds(distances: Floats, arrived: Floats, lost: Floats, what: str) -> DistanceFit:
    """The line of the log-odds of an arrival that makes the counts of all points likeliest, so that a place where few
    packets were sent says little.

    :param distances: m
    :param arrived, lost: packets of each point
    :param what: names the points in errors
    :raises ConfigError: for points that tell no slope
    """
    along = _told(distances, what)
    count = len(distances)
    middle, scale = along.mean(), along.std()
    basis = np.stack([np.ones(count), (along - middle) / scale], 1)
    ones, all_of = arrived + 0.5 / count, arrived + lost + 1 / count  # one packet more, or no line is too steep
    line = np.zeros(2)
    for _ in range(_STEPS):
        share = 1 / (1 + np.exp(-basis @ line))
        curvature = basis.T @ (basis * (all_of * share * (1 - share))[:, None]) + _FLAT * np.eye(2)
        step = np.linalg.solve(curvature, basis.T @ (ones - all_of * share))
        line = line + step / max(1.0, float(np.abs(step).max()))
    share = 1 / (1 + np.exp(-basis @ line))
    sent = arrived + lost
    left = float((sent * (lost / sent - (1 - share)) ** 2).sum() / sent.sum())
    slope = float(line[1]) / scale
    error = float(np.sqrt(np.linalg.inv(curvature)[1, 1])) / scale
    return DistanceFit(float(line[0] - slope * middle), slope, error, sqrt(left), count)


def _told(distances: Floats, what: str) -> Floats:
    """The distances in decades, where they tell a slope.

    :raises ConfigError: otherwise
    """
    count = len(distances)
    near, far = (max(NEAR_M, float(distances.min())), float(distances.max())) if count else (NEAR_M, NEAR_M)
    if count < _LEAST_POINTS or far < _LEAST_RATIO * near:
        raise ConfigError(
            f"{what}: {count} places from {near:.1f} to {far:.1f} m say no path loss; drive so that the farthest of "
            f"{_LEAST_POINTS} or more is {_LEAST_RATIO} times as far as the nearest"
        )
    return _decades(distances)


def _decades(distances: Floats) -> Floats:
    return np.asarray(10 * np.log10(np.maximum(distances, NEAR_M)))
