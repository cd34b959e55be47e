"""Counts signals that stand out of the noise, whether or not the receiver finds a packet in them."""

from __future__ import annotations

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


class EnergyCounter(KeepsThreadState, gr.sync_block):  # type: ignore[misc]
    """Takes received samples.

    :param sample_rate: samples/s
    :ivar bursts: how often the power rose above the noise
    """

    def __init__(self, sample_rate: float) -> None:
        super().__init__("gr_ros2_energy_counter", [np.complex64], None)
        self.set_output_multiple(_CHUNK)
        self.bursts = 0
        self._rise = 2 ** (_CHUNK / (sample_rate * DOUBLES_S))
        self._noise = 0.0
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
        blanked = ~input_items[0][:whole].reshape(-1, _CHUNK).all(axis=1)  # zeros are not noise
        power = power[np.isfinite(power) & ~blanked]
        steps = self._rise ** np.arange(1, len(power) + 1)
        # The lowest power so far, each one grown since: noise[n] = min(power[k] * rise^(n - k), k <= n).
        before = self._noise if self._noise else float("inf")
        noise = steps * np.minimum.accumulate(np.minimum(power / steps, before))
        above = power > STANDS_OUT * noise
        if len(power):
            self.bursts += int(np.count_nonzero(above[1:] & ~above[:-1])) + bool(above[0] and not self._above)
            self._above, self._noise = bool(above[-1]), float(noise[-1])
        return whole
