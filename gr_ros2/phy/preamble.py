"""The preamble of single-carrier bursts: how a burst is found, and its carrier, timing and SNR measured.

Invariants: a burst is found by correlating the phase steps of its preamble, so carrier offset does not prevent this; it
is accepted only if a single carrier then explains the preamble.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gr_ros2.phy.burst import Samples, Search

PREAMBLE = 64
"""Symbols of the preamble: a first one and the 63 phase steps of a maximum-length sequence."""
_THRESHOLD = 0.31
"""Threshold of the normalised correlation of the phase steps, above which samples are examined closely. Noise alone
passes once in 500; a readable burst has 0.35 with a code, 0.7 without one."""
_ALIKE = 0.28
"""Threshold of the share of the preamble's power in a single carrier; a burst is above it. A readable burst has 0.3;
noise reaches the threshold once in several 10^6 samples."""
RISE = 16
"""Symbols before its peak at which the correlation of a strong burst may pass the threshold."""
_EDGE = 4
"""Symbols at either end of the preamble that may be disturbed by the neighbouring samples."""
_REACH = 3
"""Half symbols on either side of a symbol that contribute to it: echoes, and the tails of the pulse."""
_TINY = 1e-30


def preamble_steps() -> NDArray[np.int8]:
    """63 signs, the maximum-length sequence of x^6 + x^5 + 1."""
    state, steps = 0x3F, []
    for _ in range(PREAMBLE - 1):
        steps.append(1 if state & 1 else -1)
        state = state >> 1 | ((state ^ state >> 1) & 1) << 5
    return np.array(steps, np.int8)


class _Carrier(NamedTuple):
    """A preamble's symbols without their signs, and the remaining carrier.

    :param symbols: symbols as received
    :param frequency: radians per symbol, without the modulation's own rotation
    :param alike: share of the symbols' power that this carrier explains, 0..1
    """

    symbols: Samples
    frequency: float
    alike: float


class Preamble:
    """Finds preambles in filtered samples; the reference sample is that of the first symbol.

    :param sps: samples per symbol, 2 or more
    :param turn: phase step of the modulation in addition to data and carrier, radians per symbol
    :ivar known: its symbols as sent
    """

    def __init__(self, sps: int, turn: float) -> None:
        self.sps, self._turn = sps, turn
        self._steps = preamble_steps().astype(np.float32)
        known = np.concatenate(([1], np.cumprod(preamble_steps()))) * np.exp(1j * turn * np.arange(PREAMBLE))
        self.known = known.astype(np.complex64)

    def prepare(self, wave: Samples, taps: Samples | NDArray[np.float32]) -> None:
        """Compute the preamble after the receive filter, without noise.

        :param wave: the first samples of every burst, as sent
        :param taps: of the filter
        """
        pause = np.zeros(2 * RISE * self.sps)
        clean = np.convolve(np.concatenate((pause, wave, pause)), taps).astype(np.complex64)
        start = self.find(clean).start
        assert start is not None
        inner = np.arange(_EDGE, PREAMBLE - _EDGE)
        places = start + inner * self.sps
        shifts = [round(half * self.sps / 2) for half in range(-_REACH, _REACH + 1)]
        columns = np.stack([clean[places + shift] for shift in shifts], axis=1) * self.known[inner, None].conj()
        self._clean_energy = float((np.abs(columns[:, _REACH]) ** 2).sum())
        # An error of the measured carrier rotates a column in proportion to its position.
        columns = np.concatenate((columns, columns[:, _REACH : _REACH + 1] * (inner[:, None] - PREAMBLE / 2)), axis=1)
        basis, _ = np.linalg.qr(columns)
        self._explained = np.asarray(basis.conj().T, np.complex64)

    def find(self, samples: Samples) -> Search:
        """Look for the first preamble."""
        sps = self.sps
        positions = len(samples) - (PREAMBLE - 1) * sps
        if positions <= 0:
            return Search(0)
        steps = samples[sps:] * samples[:-sps].conj()
        match, chance = np.empty((2, positions), np.float32)
        for phase in range(min(sps, positions)):
            real = np.ascontiguousarray(steps[phase::sps].real)
            imag = np.ascontiguousarray(steps[phase::sps].imag)
            match[phase::sps] = np.correlate(real, self._steps) ** 2 + np.correlate(imag, self._steps) ** 2
            chance[phase::sps] = np.correlate(real**2 + imag**2, self._steps**2)
        # For random steps, the square of their sum is on average the sum of their squares. This holds for 63 steps of
        # noise, and for a few steps of a burst where a window reaches into silence. If the square were divided by the
        # power instead, those few steps would often look like a preamble.
        above = np.flatnonzero(match > _THRESHOLD**2 * (PREAMBLE - 1) * chance + _TINY)
        at = 0
        while at < len(above):
            first = int(above[at])
            if first + RISE * sps > positions:  # the maximum may still come
                return Search(first)
            best = first + int(np.argmax(match[first : first + RISE * sps]))
            if self._carrier(samples, best).alike > _ALIKE:
                return Search(first, best)
            at = int(np.searchsorted(above, best + 1))
        return Search(positions)

    def measure(self, samples: Samples, start: int) -> tuple[float, float, float]:
        """Carrier frequency and phase from the preamble, in radians per symbol and radians, and SNR.

        The rotation of the modulation counts as carrier frequency here.
        """
        symbols, frequency, _ = self._carrier(samples, start)
        straight = symbols * np.exp(-1j * frequency * np.arange(PREAMBLE))
        return frequency + self._turn, float(np.angle(straight.sum())), self._snr(straight[_EDGE:-_EDGE])

    def _carrier(self, samples: Samples, start: int) -> _Carrier:
        """Examine a preamble closely."""
        size = 4 * PREAMBLE
        symbols = samples[start : start + PREAMBLE * self.sps : self.sps] * self.known.conj()
        height = np.abs(np.fft.fft(symbols, size))
        peak = int(np.argmax(height))
        place = peak + parabola_peak(height[peak - 1], height[peak], height[(peak + 1) % size])
        frequency = 2 * np.pi * ((place + size / 2) % size - size / 2) / size
        power = PREAMBLE * float(np.vdot(symbols, symbols).real)
        return _Carrier(symbols, frequency, float(height[peak]) ** 2 / max(power, _TINY))

    def _snr(self, received: Samples) -> float:
        """Mean power of a burst over that of the noise, from its preamble's inner symbols.

        Interference from neighbouring symbols (by an echo, a timing between samples or the pulse) does not count as
        noise.
        """
        explained = self._explained @ received
        unknowns, count = self._explained.shape
        total = float(np.vdot(received, received).real)
        rest = max(total - float(np.vdot(explained, explained).real), _TINY)
        noise = rest / (count - unknowns)
        return float((total - count * noise) / (self._clean_energy * noise))

    def lateness(self, samples: Samples, start: int, frequency: float) -> float:
        """Samples by which the preamble's symbols are later than ``start``, -0.5..0.5."""
        model = self.known.conj() * np.exp(-1j * (frequency - self._turn) * np.arange(PREAMBLE))
        heights = (
            abs((samples[at : at + PREAMBLE * self.sps : self.sps] * model).sum())
            for at in (start - 1, start, start + 1)
        )
        return parabola_peak(*(float(height) for height in heights))

    def constants(self) -> dict[str, Any]:
        """What the compiled kernel has to know of it."""
        return {
            "preamble": PREAMBLE,
            "rise": RISE,
            "edge": _EDGE,
            "unknowns": len(self._explained),
            "turn": self._turn,
            "clean_energy": self._clean_energy,
            "threshold": _THRESHOLD,
            "alike": _ALIKE,
            "steps": self._steps,
            "known": self.known,
            "explained": self._explained,
        }


def parabola_peak(before: float, at: float, after: float) -> float:
    """Position of the maximum of the parabola through three neighbours, -0.5..0.5 from the middle one."""
    bend = before - 2 * at + after
    return float(np.clip(0.5 * (before - after) / bend, -0.5, 0.5)) if bend < 0 else 0.0
