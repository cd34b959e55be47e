"""Rayleigh fading as a function of time, so that it also goes on while nothing is sent."""

from __future__ import annotations

import math
import random
from typing import Any

import numpy as np
from numpy.typing import NDArray

_SINUSOIDS = 32


class RayleighFading:
    """Flat fading with the classical Doppler spectrum, as a sum of sinusoids (Clarke, 1968; Jakes, 1974).

    :param doppler_hz: largest Doppler shift, Hz
    """

    def __init__(self, doppler_hz: float, seed: int) -> None:
        draw = random.Random(f"fading {seed}")
        turn = 2 * math.pi
        waves = [(turn * doppler_hz * math.cos(turn * draw.random()), turn * draw.random()) for _ in range(_SINUSOIDS)]
        self._pulses, self._phases = np.array(waves).T

    def gain(self, times: Any) -> NDArray[np.complex128]:
        """Complex gain at times in s; its mean power is 1."""
        angles = np.multiply.outer(times, self._pulses) + self._phases
        return np.asarray((np.cos(angles) + 1j * np.sin(angles)).sum(-1) / math.sqrt(_SINUSOIDS))

    def gain_db(self, now: float) -> float:
        """Power gain at a time in s, dB."""
        return float(10 * np.log10(np.maximum(np.abs(self.gain(now)) ** 2, 1e-12)))
