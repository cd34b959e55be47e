"""The spectrum of the received signal, averaged so that the picture is steady.

Invariant: powers are relative to the strongest bin of the average, in dB. Only one running average is kept.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from gr_ros2.core.arrays import Floats

BINS = 256
_SMOOTHING = 0.25
"""Weight of new samples in the running average."""
_FLOOR = 1e-12


class Spectrum:
    """Averaged power over frequency.

    :param sample_rate: samples/s
    """

    def __init__(self, sample_rate: float) -> None:
        self.frequencies: Floats = np.fft.fftshift(np.fft.fftfreq(BINS, 1 / sample_rate))
        """Hz from the centre, ascending."""
        self._window = np.hanning(BINS)
        self._power: Floats | None = None

    def add(self, samples: npt.NDArray[np.complex64]) -> None:
        """Add consecutive samples, in blocks of ``BINS``. An incomplete block is ignored, and one with a sample that is
        no finite number."""
        blocks = samples[: len(samples) // BINS * BINS].reshape(-1, BINS)
        blocks = blocks[np.isfinite(blocks).all(axis=1)]
        if not len(blocks):
            return
        power = (np.abs(np.fft.fftshift(np.fft.fft(blocks * self._window), axes=1)) ** 2).mean(axis=0)
        self._power = power if self._power is None else self._power + _SMOOTHING * (power - self._power)

    def decibels(self) -> Floats | None:
        """Power of each bin relative to the strongest one, dB; None before the first samples."""
        if self._power is None:
            return None
        decibels: Floats = 10 * np.log10(np.maximum(self._power / max(self._power.max(), _FLOOR), _FLOOR))
        return decibels
