"""The `psk` PHY: single carrier, BPSK, QPSK or 8-PSK in root-raised-cosine pulses, a preamble before each packet.

Invariant: the mean power of a burst is 1 whatever the settings.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numpy as np
from gnuradio.filter import firdes
from numpy.typing import NDArray
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from gr_ros2.phy.burst import Frames
from gr_ros2.phy.linear import LinearModem, LinearOptions, LinearPhy

_ORDER = {"bpsk": 2, "qpsk": 4, "8psk": 8}
_PULSE_SYMBOLS = 10


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class PskOptions(LinearOptions):
    """Settings of this PHY beside packet length and sample rate, and those of every burst PHY."""

    modulation: Literal["bpsk", "qpsk", "8psk"] = "qpsk"
    """of the payload; the preamble is BPSK always"""
    rolloff: Annotated[float, Field(ge=0.2, le=1, title="Roll-off factor")] = 0.35
    """of the root-raised-cosine pulse, 0.2..1"""


class PskModem(LinearModem):
    """A single carrier with root-raised cosine pulses."""

    def __init__(self, frames: Frames, options: PskOptions) -> None:
        super().__init__(frames, _ORDER[options.modulation], options.sps)
        taps = firdes.root_raised_cosine(1.0, options.sps, 1.0, options.rolloff, _PULSE_SYMBOLS * options.sps + 1)
        pulse = np.array(taps)
        pulse /= np.sqrt((pulse**2).sum())
        self.taps: NDArray[np.float32] = pulse.astype(np.float32)
        self.pulse = pulse  # whose length gives the energy of a symbol
        self.pulse = pulse * np.sqrt(self.symbol_energy)
        self.head.prepare(self.preamble, self.taps)

    @property
    def symbol_energy(self) -> float:
        return self.burst_samples / self.symbols(self.frames.packet_len)


class PskPhy(LinearPhy):
    """Single carrier for narrow channels without echoes: use `ofdm` where an echo is as long as a symbol.

    Carrier offset up to 5 % of the symbol rate, clocks within 100 ppm; packets of 1..4095 B.

    :param options: see :class:`PskOptions`
    :raises ConfigError: for an option that is unknown or out of range
    """

    name = "psk"
    Options = PskOptions

    def __init__(self, packet_len: int, sample_rate: float, **options: Any) -> None:
        super().__init__(packet_len, sample_rate, **options)
        self.modem = PskModem(self.frames(), self.options)
