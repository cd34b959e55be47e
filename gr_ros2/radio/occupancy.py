"""For which share of the time each part of a band is above the noise.

Invariants: samples that are no finite numbers, and blocks of nothing but zeros (a driver that has not started), are
left out and counted. There is no GNU Radio, and no clock.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

PARTS = 32
"""Parts of the band."""
_BINS = 512
"""Frequencies of a block: 16 of each part, so that noise alone stands out of the floor once in 10^4 blocks."""
_QUIET = 0.25
"""Share of the blocks that set the floor of each part: something may be on the air for three quarters of the time."""
STANDS_OUT = 4.0
"""Power over the floor from which on a part is busy: 6 dB."""
SELDOM = 0.005
"""Share of the time up to which a part is not said to be busy: what no link notices."""
_ALIKE = 0.9
"""Ratio of the shares of two parts from which on one number says both."""
MOST_SAID = 4
"""Stretches of the band that are said to be busy."""


class Occupancy:
    """Power of each part of a band in block after block.

    :param most: pieces of samples that count, the newest; None for all
    :ivar zeros, not_finite: blocks that were left out
    """

    def __init__(self, most: int | None = None) -> None:
        self._window = np.hanning(_BINS)
        self._scale = _BINS * float((self._window**2).sum())
        self._powers: deque[NDArray[np.float64]] = deque(maxlen=most)
        self.zeros = self.not_finite = 0

    def add(self, samples: NDArray[np.complex64]) -> None:
        """Consecutive samples; an incomplete block at their end is left out."""
        blocks = samples[: len(samples) // _BINS * _BINS].reshape(-1, _BINS).astype(np.complex128)
        finite = np.isfinite(blocks).all(axis=1)
        silent = finite & ~blocks.any(axis=1)
        self.not_finite += int((~finite).sum())
        self.zeros += int(silent.sum())
        power = np.abs(np.fft.fftshift(np.fft.fft(blocks[finite & ~silent] * self._window), axes=1)) ** 2
        self._powers.append(power.reshape(-1, PARTS, _BINS // PARTS).sum(axis=2) / self._scale)

    def found(self) -> Found | None:
        """What was heard; None before the first block.

        The floor is that of most parts: what fills more than half of the band all the time counts as noise.
        """
        powers = np.concatenate(self._powers) if self._powers else np.empty((0, PARTS))
        if not len(powers):
            return None
        floor = float(np.median(np.quantile(powers, _QUIET, axis=0)))
        busy = (powers > STANDS_OUT * floor).mean(axis=0)
        return Found(len(powers), floor, powers.mean(axis=0), powers.max(axis=0), busy)


class Found(NamedTuple):
    """What was heard.

    :ivar blocks: number of blocks
    :ivar floor: power of the noise in a part; 1 is that of a carrier of full scale
    :ivar mean, peak: power in each part, on average and in the block where it was highest
    :ivar busy: share of the blocks in which each part is above the noise
    """

    blocks: int
    floor: float
    mean: NDArray[np.float64]
    peak: NDArray[np.float64]
    busy: NDArray[np.float64]


def in_parts(found: Found, sample_rate: float, middle: float) -> list[dict[str, float]]:
    """What was heard in each part: where it is in Hz, its power in dB of full scale, and how busy it is.

    :param middle: frequency in the middle of the band, Hz
    """
    edges = [middle + sample_rate * (n / PARTS - 0.5) for n in range(PARTS + 1)]
    return [
        {"from_hz": low, "to_hz": high, "mean_db": mean, "peak_db": peak, "busy": busy}
        for low, high, mean, peak, busy in zip(
            edges,
            edges[1:],
            decibels(found.mean).tolist(),
            decibels(found.peak).tolist(),
            found.busy.tolist(),
            strict=False,
        )
    ]


def decibels(power: NDArray[np.float64] | float) -> NDArray[np.float64]:
    """Power in dB of full scale."""
    return np.asarray(10 * np.log10(np.maximum(power, 1e-30)))


def busy_words(parts: Sequence[Mapping[str, Any]], unit: float, name: str) -> str:
    """Where the band is busy, the busiest first: each with its neighbours that are at least half as busy, so that what
    a burst's edges throw over the whole band does not hide where it is.

    :param unit, name: Hz of the unit in which it is said, and its name
    """
    busy = [float(part["busy"]) for part in parts]
    left = {n for n, share in enumerate(busy) if share > SELDOM}
    said: list[str] = []
    while left and len(said) < MOST_SAID:
        low = high = peak = max(left, key=busy.__getitem__)
        while low - 1 in left and 2 * busy[low - 1] >= busy[peak]:
            low -= 1
        while high + 1 in left and 2 * busy[high + 1] >= busy[peak]:
            high += 1
        left.difference_update(range(low, high + 1))
        between = f"{parts[low]['from_hz'] / unit:,.7g} to {parts[high]['to_hz'] / unit:,.7g} {name}"
        least = min(busy[low : high + 1])
        shares = f"{busy[peak]:.1%}"
        if least < _ALIKE * busy[peak]:
            middle = (parts[peak]["from_hz"] + parts[peak]["to_hz"]) / 2 / unit
            shares = f"{least:.1%} to {shares}, most around {middle:,.7g} {name},"
        said.append(f"{between} for {shares} of the time")
    return f"busy: {'; '.join(said)}" if said else "nothing stands out of the noise"
