"""The `psk` PHY: single carrier, BPSK, QPSK or 8-PSK in root-raised-cosine pulses, a preamble before each packet.

Invariant: the mean power of a burst is 1 whatever the settings.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numpy as np
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


def root_raised_cosine(sps: int, rolloff: float) -> NDArray[np.float64]:
    """A root-raised-cosine pulse of energy 1, ten symbols long.

    This is here because ``gnuradio.filter``, which has one too, takes 10 MB of memory and a tenth of a link's start.

    :param sps: samples per symbol, at least 2
    :param rolloff: above 0, at most 1
    """
    time = np.arange(-_PULSE_SYMBOLS * sps // 2, _PULSE_SYMBOLS * sps // 2 + 1) / sps
    wide = np.pi * (1 + rolloff) * time
    slope = 4 * rolloff * time
    with np.errstate(divide="ignore", invalid="ignore"):
        pulse = (slope * np.cos(wide) + np.sin(np.pi * (1 - rolloff) * time)) / (np.pi * time * (1 - slope**2))
    pulse[time == 0] = 1 + rolloff * (4 / np.pi - 1)
    quarter = np.pi / (4 * rolloff)
    at_edge = rolloff / np.sqrt(2) * ((1 + 2 / np.pi) * np.sin(quarter) + (1 - 2 / np.pi) * np.cos(quarter))
    pulse[np.isclose(np.abs(slope), 1)] = at_edge
    return np.asarray(pulse / np.sqrt((pulse**2).sum()))


class PskModem(LinearModem):
    """A single carrier with root-raised cosine pulses."""

    def __init__(self, frames: Frames, options: PskOptions) -> None:
        super().__init__(frames, _ORDER[options.modulation], options.sps)
        pulse = root_raised_cosine(options.sps, options.rolloff)
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
