"""The latency of deliveries as quantiles; without deliveries there is none."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gr_ros2.core.arrays import Floats

CDF_POINTS = 101
"""Number of quantiles in a stored CDF: 0 %, 1 %, … 100 %."""


@dataclass(frozen=True, slots=True)
class Latency:
    """s from submission to republication: quantiles (linear between samples) and maximum."""

    p50: float
    p95: float
    p99: float
    max: float


def latency(latencies: Floats) -> Latency | None:
    """Median, p95, p99 and maximum; None without samples."""
    if not len(latencies):
        return None
    p50, p95, p99, top = (float(value) for value in np.percentile(latencies, [50, 95, 99, 100]))
    return Latency(p50, p95, p99, top)


def latency_cdf(latencies: Floats) -> tuple[float, ...]:
    """The latencies below which 0 %, 1 %, … 100 % of the samples lie; () without samples."""
    if not len(latencies):
        return ()
    return tuple(float(value) for value in np.percentile(latencies, np.linspace(0, 100, CDF_POINTS)))
