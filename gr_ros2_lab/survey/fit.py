"""The straight line over the logarithm of the distance that fits what was measured, and how far to trust it."""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt

import numpy as np

from gr_ros2.core.arrays import Floats
from gr_ros2.core.errors import ConfigError

NEAR_M = 1.0
"""Distance from which on the line holds; nearer ends count as this far apart."""
_LEAST_POINTS, _LEAST_RATIO = 5, 1.5
"""Fewest points of a fit, and the least ratio of the farthest distance to the nearest."""


@dataclass(frozen=True)
class DistanceFit:
    """``at_1_m + slope * 10 log10(distance)``. Of an SNR the slope is minus the exponent of the path loss.

    :param slope_error: standard deviation of the slope, where the points are independent
    :param rms: what is left, as a root of the mean square
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
    count = len(distances)
    near, far = (max(NEAR_M, float(distances.min())), float(distances.max())) if count else (NEAR_M, NEAR_M)
    if count < _LEAST_POINTS or far < _LEAST_RATIO * near:
        raise ConfigError(
            f"{what}: {count} places from {near:.1f} to {far:.1f} m say no path loss; drive so that the farthest of "
            f"{_LEAST_POINTS} or more is {_LEAST_RATIO} times as far as the nearest"
        )
    along = _decades(distances)
    middle = along.mean()
    spread = float(((along - middle) ** 2).sum())
    slope = float(((along - middle) * values).sum()) / spread
    at_1_m = float(values.mean() - slope * middle)
    left = values - at_1_m - slope * along
    squares = float((left**2).sum())
    return DistanceFit(at_1_m, slope, sqrt(squares / (count - 2) / spread), sqrt(squares / count), count)


def _decades(distances: Floats) -> Floats:
    return np.asarray(10 * np.log10(np.maximum(distances, NEAR_M)))
