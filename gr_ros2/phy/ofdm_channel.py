"""The channel that an OFDM burst went through, estimated from its sync words and tracked with its own payload.

Invariants: the channel is a short impulse response, so its estimate at one carrier uses all carriers; the estimate is
tracked with the decided payload symbols, weighted by their certainty.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gr_ros2.phy.burst import Samples
from gr_ros2.phy.ofdm_layout import OfdmLayout
from gr_ros2.phy.soft import Points

Complexes = NDArray[np.complexfloating[Any, Any]]
"""Complex numbers of single or double precision."""

_MEMORY = 32.0
"""Symbols over which the channel estimate averages."""
_RIDGE = 0.001
"""Noise over signal per carrier for which the channel estimate is designed."""
_TURN = 0.4
"""Largest error of the carrier offset after the sync words, radians per symbol."""
_DOUBT = 1e-3
"""Share of the power sent: if the uncertainty is below this, symbols are not decided again for a better estimate."""
_TINY = 1e-20
UNSTEADY = 1e-3
"""Samples by which what is measured of the timing is off at least."""


class ChannelState(NamedTuple):
    """Gain of each used carrier, the weight of its estimate, and the noise on each carrier."""

    gains: NDArray[np.complex128]
    weight: NDArray[np.float64]
    noise: float


class ChannelEstimator:
    """The estimator of one layout. Symbols are arrays of symbols by used carriers.

    :param words: both sync words by all carriers, the middle one first
    :ivar carriers: numbers of the used carriers
    :ivar data: places of those with data among them
    :ivar pilots: places of those with a known sign among them
    :ivar known: what the pilots carry, 0 elsewhere
    :ivar words: what the sync words carry
    """

    def __init__(self, layout: OfdmLayout, words: NDArray[np.complex128]) -> None:
        self._size = layout.fft_len
        self.carriers = np.array(sorted(layout.data[0] + layout.pilots[0]))
        self.data = np.flatnonzero(np.isin(self.carriers, layout.data[0]))
        self.pilots = np.searchsorted(self.carriers, layout.pilots[0])
        self.known = np.zeros(len(self.carriers), np.complex64)
        self.known[self.pilots] = layout.pilot_symbols[0]
        self.words = words[:, self.carriers].astype(np.complex64)
        self._twice, self._once = np.flatnonzero(self.words[0]), np.flatnonzero(self.words[0] == 0)
        self._crosswise = self.words[::-1, self._twice]
        self._pair_weight = float((np.abs(self._crosswise) ** 2).sum()) / len(self._twice)
        delays = np.arange(layout.cp_len)
        basis = np.exp(-2j * np.pi * np.outer(self.carriers, delays) / self._size)

        def smoother(weight: NDArray[np.float64]) -> NDArray[np.complex64]:
            gram = basis.conj().T @ (basis * weight[:, None])
            gram += _RIDGE * len(self.carriers) * np.eye(len(delays))
            return np.asarray(basis @ np.linalg.solve(gram, basis.conj().T), np.complex64)

        self._word_weight = (np.abs(self.words) ** 2).sum(axis=0).astype(np.float64)
        self._smooth_words = smoother(self._word_weight)
        self._smooth = smoother(np.ones(len(self.carriers)))
        self._degrees = 2 * len(self.carriers) - len(delays)

    def constants(self) -> dict[str, Any]:
        """What the compiled kernel has to know of it."""
        return {
            "degrees": self._degrees,
            "once_count": len(self._once),
            "twice_count": len(self._twice),
            "pair_weight": self._pair_weight,
            "word_weight_sum": float(self._word_weight.sum()),
            "memory": _MEMORY,
            "reach": _TURN,
            "doubt": _DOUBT,
            "once": self._once,
            "twice": self._twice,
            "smooth": self._smooth,
            "smooth_words": self._smooth_words,
            "crosswise": self._crosswise,
            "word_weight": self._word_weight,
        }

    def advance(self, samples: Any) -> NDArray[np.complex128]:
        """Factors that advance carriers by a number of samples, fractional or not."""
        return np.asarray(np.exp(2j * np.pi / self._size * self.carriers * samples))

    def first(self, rows: NDArray[np.complex64]) -> ChannelState:
        """The estimate from the carriers of both sync words."""
        gains = self._smooth_words @ (rows * self.words.conj()).sum(axis=0)
        rest = rows - gains * self.words
        noise = float((np.abs(rest) ** 2).sum()) / self._degrees
        return ChannelState(gains, self._word_weight, max(noise, _TINY))

    def snr(self, rows: NDArray[np.complex64], power: float) -> float:
        """Mean power of a burst over that of the noise in the sampled band, from both sync words.

        The noise is measured on the carriers that the first word leaves empty, and from the difference of both words on
        the others. So it does not depend on the channel.

        :param rows: carriers of the sync words
        :param power: mean power of a burst as sent
        """
        first, second = rows[:, self._twice] * self._crosswise
        alike = abs(complex(np.vdot(first, second)))
        differ = float(np.vdot(first, first).real + np.vdot(second, second).real) - 2 * alike
        empty = float(np.vdot(rows[0, self._once], rows[0, self._once]).real)
        noise = max(empty + differ / self._pair_weight, _TINY) / (len(self.carriers) - 0.5)
        signal = float(np.vdot(rows, rows).real) - rows.size * noise
        return signal * power / (float(self._word_weight.sum()) * noise * self._size)

    def decide(
        self, rows: Complexes, channel: ChannelState, points: Points, used: NDArray[np.bool_], rounds: int = 2
    ) -> tuple[ChannelState, NDArray[np.float32], Samples, float, float]:
        """Likelihoods of constellation points for some symbols, with a channel estimate improved by these symbols.

        Also returns the delay of the symbols in samples, and its variance.

        :param used: symbols by data carriers: which of them carry a point
        :param rounds: most rounds of decision and estimation
        """
        gains, noise = channel.gains, channel.noise
        turn = self._tone(rows[:, self.pilots] @ (gains[self.pilots] * self.known[self.pilots]).conj())
        rows = rows * turn[:, None]
        model = np.empty(rows.shape, np.complex64)
        energy = np.ones(rows.shape, np.float32)
        late = 0.0
        for _ in range(rounds):
            likely, _ = self._weigh(rows, gains, noise, points, used)
            expected, squared = points.expected(likely)
            model[:] = self.known
            model[:, self.data] = 0
            model[:, self.data] = _put(expected, used)
            energy[:, self.data] = _put(squared, used)
            turns = rows * (gains * model).conj()
            turn = self._tone(turns.sum(axis=1))
            more, firm = self._late(turn @ turns)
            late += more
            rows = rows * turn[:, None] * self.advance(more)
            weight = np.minimum(channel.weight, _MEMORY)
            total = weight + energy.sum(axis=0)
            gains = self._smooth @ ((weight * channel.gains + (rows * model.conj()).sum(axis=0)) / total)
            if np.vdot(expected, expected).real > (1 - _DOUBT) * squared.sum():
                break
        likely, seen = self._weigh(rows, gains, noise, points, used)
        variance = noise / (2 * firm) + UNSTEADY**2
        return ChannelState(gains, total, noise), likely, seen, late, variance

    def _weigh(
        self, rows: Complexes, gains: NDArray[np.complex128], noise: float, points: Points, used: NDArray[np.bool_]
    ) -> tuple[NDArray[np.float32], Samples]:
        gains = gains[self.data]
        power = np.abs(gains) ** 2 + _TINY
        seen = (rows[:, self.data] * (gains.conj() / power))[used].astype(np.complex64)
        return points.weigh(seen, np.tile(noise / power, len(used))[used.reshape(-1)]), seen

    def _tone(self, turns: NDArray[np.complex64]) -> NDArray[np.complex64]:
        """Factors that remove a constant phase step from symbol to symbol."""
        count = len(turns)
        size = 8 << max(0, (count - 1).bit_length())
        spectrum = np.fft.fft(turns, size)
        reach = int(size * _TURN / (2 * np.pi))
        places = np.arange(-reach, reach + 1)
        heights = np.abs(spectrum[places])
        place = int(np.argmax(heights))
        exact = float(places[place])
        if 0 < place < len(places) - 1:
            before, at, after = heights[place - 1 : place + 2]
            bend = before - 2 * at + after
            exact += 0.5 * (before - after) / bend if bend < 0 else 0.0
        back = np.exp(-2j * np.pi * exact / size * np.arange(count))
        phase = float(np.angle((turns * back).sum()))
        return np.asarray(back * np.exp(-1j * phase), np.complex64)

    def _late(self, turns: NDArray[np.complex128]) -> tuple[float, float]:
        """Delay of symbols in samples, from the phase slope over their carriers, and what its variance is the noise
        over twice of."""
        places = 2 * np.pi / self._size * self.carriers
        firm = max(float(places**2 @ np.abs(turns.real)), _TINY)
        return -float(places @ turns.imag) / firm, firm


def _put(values: NDArray[np.generic], used: NDArray[np.bool_]) -> NDArray[np.generic]:
    """Values at the used places, zeros elsewhere."""
    out = np.zeros(used.shape, values.dtype)
    out[used] = values
    return out
