"""Samples at other times: a stream read at another pace, between its samples.

A windowed sinc, from a table of its values at fractions of a sample: what it leaves out of 0.9 of the band is 60 dB
below the signal.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

REACH = 12
"""Samples on either side of which a value between two is made."""
FRACTIONS = 512


@cache
def weights() -> NDArray[np.float32]:
    """Of the samples around a place, one row for each fraction of a sample, 0 and 1 included."""
    away = np.arange(-REACH + 1, REACH + 1) - np.arange(FRACTIONS + 1)[:, None] / FRACTIONS
    return np.asarray(np.sinc(away) * np.cos(np.pi * away / (2 * REACH + 2)) ** 2, np.float32)


def stretched(samples: NDArray[np.complex64], first: float, pace: float, count: int) -> NDArray[np.complex64]:
    """``count`` samples from a place on, each ``1 + pace`` after the one before; what is not there is 0."""
    at = first + (1 + pace) * np.arange(count)
    whole = np.floor(at).astype(np.int64)
    rows = weights()[np.rint((at - whole) * FRACTIONS).astype(np.int64)]
    begin, end = int(whole[0]) - REACH + 1, int(whole[-1]) + REACH + 1
    padded = np.zeros(end - begin, np.complex64)
    low, high = max(begin, 0), min(end, len(samples))
    padded[low - begin : max(high, low) - begin] = samples[low : max(high, low)]
    out = np.zeros(count, np.complex64)
    for tap in range(2 * REACH):
        out += rows[:, tap] * padded[whole - begin - REACH + 1 + tap]
    return out
