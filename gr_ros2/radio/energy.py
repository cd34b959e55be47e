"""Counts signals that stand out of the noise, whether or not the receiver finds a packet in them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import inf
from typing import Any

import numpy as np
from gnuradio import gr
from numpy.typing import NDArray

from gr_ros2.phy.threads import KeepsThreadState

STANDS_OUT = 4.0
"""Power over that of the noise from which on something is a signal: 6 dB."""
_CHUNK = 256
"""Samples whose mean power is compared: of noise, it is above ``STANDS_OUT`` less than once in 10^100."""
DOUBLES_S = 5.0
"""s in which the noise's estimate doubles at most. It follows a smaller power at once, so it is the lowest power of
late. A carrier 20 dB above the noise counts as a signal for 23 s and then as noise: whoever listens before sending does
not fall silent for ever."""

_SILENCE = 2 * STANDS_OUT
"""Samples that are all zero are silence, so many times below the weakest power that came. Twice as much would still
be a signal; noise that begins after zeros, as a driver may give at its start, counts as one for ``DOUBLES_S`` only."""
_WEAKEST = 1e-8
"""Power over the greatest one below which nothing is a signal: the edges of a burst beside zeros. After such an edge,
noise counted as a signal for minutes."""


class EnergyCounter(KeepsThreadState, gr.sync_block):  # type: ignore[misc]
    """Takes received samples.

    :param sample_rate: samples/s
    :param blanked_in: returns where samples were set to zero from one sample to before another, counted from the start;
        these are neither noise nor silence. None: nowhere
    :ivar bursts: how often the power rose above the noise
    """

    def __init__(
        self, sample_rate: float, blanked_in: Callable[[int, int], Sequence[tuple[int, int]]] | None = None
    ) -> None:
        super().__init__("gr_ros2_energy_counter", [np.complex64], None)
        self.set_output_multiple(_CHUNK)
        self.bursts = 0
        self._rise = 2 ** (_CHUNK / (sample_rate * DOUBLES_S))
        self._blanked_in = blanked_in
        self._noise = self._weakest = inf
        """Power of the noise, and the least power of a chunk that is not zero; infinite while it is not known."""
        self._strongest = 0.0
        self._silent = False
        """Whether zeros came before anything else."""
        self._above = False

    def is_above(self) -> bool:
        """Whether the newest samples are above the noise."""
        return self._above

    def work(self, input_items: list[NDArray[np.complex64]], output_items: list[Any]) -> int:  # noqa: ARG002
        whole = len(input_items[0]) // _CHUNK * _CHUNK
        if not whole:
            return len(input_items[0])
        parts = input_items[0][:whole].view(np.float32).reshape(-1, 2 * _CHUNK)
        power = np.einsum("ij,ij->i", parts, parts)
        heard = np.isfinite(power)
        if self._blanked_in is not None:
            first = self.nitems_read(0)
            for low, high in self._blanked_in(first, first + whole):
                heard[max(low - first, 0) // _CHUNK : (high - first - 1) // _CHUNK + 1] = False
        power = power[heard]
        known = self._weakest < inf
        self._weakest = min(self._weakest, power[power > 0].min(initial=inf))
        self._strongest = max(self._strongest, power.max(initial=0.0))
        silence = max(self._weakest, _WEAKEST * self._strongest) / _SILENCE
        before = silence if self._silent and not known else max(self._noise, silence)
        self._silent |= not power.all()
        power = np.maximum(power, silence)
        steps = self._rise ** np.arange(1, len(power) + 1)
        # The lowest power so far, each one grown since: noise[n] = min(power[k] * rise^(n - k), k <= n).
        noise = steps * np.minimum.accumulate(np.minimum(power / steps, before))
        above = power > STANDS_OUT * noise  # False while nothing but zeros came
        if len(power):
            self.bursts += int(np.count_nonzero(above[1:] & ~above[:-1])) + bool(above[0] and not self._above)
            self._above, self._noise = bool(above[-1]), float(noise[-1])
        return whole
