"""Confidence intervals of a mean or a share, from the runs that were made.

Invariants: all intervals are for 95 %; a number that does not apply is None.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import atan, cos, pi, sin, sqrt
from statistics import NormalDist, mean, stdev

CONFIDENCE = 0.95
_Z = NormalDist().inv_cdf((1 + CONFIDENCE) / 2)


@dataclass(frozen=True, slots=True)
class Estimate:
    """A number with its interval. ``low`` and ``high`` are None where a single run gives no interval."""

    value: float
    low: float | None = None
    high: float | None = None


def share(successes: int, trials: int) -> Estimate | None:
    """A share and its Wilson score interval, 0..1, which is also valid at 0 and 1; None without trials.

    The interval assumes independent trials: it is too narrow if losses come in bursts.
    """
    if not trials:
        return None
    found = successes / trials
    scale = 1 + _Z**2 / trials
    middle = (found + _Z**2 / (2 * trials)) / scale
    reach = _Z * sqrt(found * (1 - found) / trials + _Z**2 / (4 * trials**2)) / scale
    # In spite of rounding errors, the interval must contain the share and stay within 0..1.
    return Estimate(found, max(min(middle - reach, found), 0.0), min(max(middle + reach, found), 1.0))


def average(values: Sequence[float]) -> Estimate | None:
    """The mean over runs and Student's t interval; None without runs, no interval with one run."""
    if not values:
        return None
    if len(values) == 1:
        return Estimate(values[0])
    middle = mean(values)
    reach = t_quantile(len(values) - 1) * stdev(values) / sqrt(len(values))
    return Estimate(middle, middle - reach, middle + reach)


def t_quantile(freedom: int) -> float:
    """t such that Student's variable lies within -t..t with probability ``CONFIDENCE``.

    :param freedom: degrees of freedom, 1 or more
    """
    low, high = 0.0, 1.0
    while _within(high, freedom) < CONFIDENCE:
        low, high = high, 2 * high
    while high - low > 1e-12 * high:
        middle = (low + high) / 2
        low, high = (middle, high) if _within(middle, freedom) < CONFIDENCE else (low, middle)
    return high


def _within(t: float, freedom: int) -> float:
    """P(-t < T < t), by the finite series for integer degrees of freedom (Abramowitz and Stegun 26.7.3 and 26.7.4)."""
    angle = atan(t / sqrt(freedom))
    odd = freedom % 2
    term = total = cos(angle) if odd else 1.0
    for k in range(2 + odd, freedom, 2):
        term *= cos(angle) ** 2 * (k - 1) / k
        total += term
    if odd:
        return 2 / pi * (angle + (sin(angle) * total if freedom > 1 else 0.0))
    return sin(angle) * total
