"""Intervals of sweeps against published tables and against many repetitions of a known experiment."""

from __future__ import annotations

import random
from statistics import mean, stdev

import pytest

from gr_ros2_lab.record.statistics import Estimate, average, share, t_quantile


@pytest.mark.parametrize(
    ("freedom", "quantile"),
    [(1, 12.706), (2, 4.303), (3, 3.182), (4, 2.776), (5, 2.571), (9, 2.262), (10, 2.228), (30, 2.042), (120, 1.980)],
)
def test_t_quantiles_are_those_of_the_tables(freedom: int, quantile: float) -> None:
    assert t_quantile(freedom) == pytest.approx(quantile, abs=5e-4)


def test_the_mean_of_runs() -> None:
    values = [1.0, 2.0, 4.0]
    found = average(values)
    assert found is not None and found.low is not None and found.high is not None
    assert found.value == pytest.approx(mean(values))
    assert found.high - found.value == pytest.approx(4.3027 * stdev(values) / 3**0.5, rel=1e-4)
    assert found.value - found.low == pytest.approx(found.high - found.value)


def test_one_run_has_no_interval_and_none_no_mean() -> None:
    assert average([0.5]) == Estimate(0.5, None, None)
    assert average([]) is None
    assert share(0, 0) is None


@pytest.mark.parametrize(
    ("successes", "trials", "low", "high"),
    [(0, 10, 0.0, 0.2775), (10, 10, 0.7225, 1.0), (5, 10, 0.2366, 0.7634), (81, 263, 0.2553, 0.3662)],
)
def test_wilson_intervals(successes: int, trials: int, low: float, high: float) -> None:
    found = share(successes, trials)
    assert found is not None
    assert (found.value, found.low, found.high) == pytest.approx((successes / trials, low, high), abs=1e-4)


@pytest.mark.parametrize("probability", [0.02, 0.5, 0.95])
def test_wilson_intervals_hold_as_often_as_they_say(probability: float) -> None:
    draw = random.Random(1)
    trials, held, times = 200, 0, 2000
    for _ in range(times):
        found = share(sum(draw.random() < probability for _ in range(trials)), trials)
        assert found is not None and found.low is not None and found.high is not None
        held += found.low <= probability <= found.high
    assert held / times == pytest.approx(0.95, abs=0.025)
