"""The `psk` PHY: single carrier, BPSK, QPSK or 8-PSK in root-raised-cosine pulses, a preamble before each packet.

Law: the mean power of a burst is 1 whatever the settings.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numpy as np
from gnuradio.filter import firdes
from numpy.typing import NDArray
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from gr_ros2.config import build
from gr_ros2.phy.burst import Samples
from gr_ros2.phy.burst_blocks import BurstPhy
from gr_ros2.phy.linear import LinearModem, shape
from gr_ros2.phy.theory import packet_success, psk_symbol_error

_ORDER = {"bpsk": 2, "qpsk": 4, "8psk": 8}
_PULSE_SYMBOLS = 10


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class PskOptions:
    """Settings of this PHY beside packet length and sample rate.

    :param modulation: of the payload; the preamble is BPSK always
    :param sps: samples per symbol, 2..64
    :param rolloff: of the root-raised-cosine pulse, 0.2..1
    :param gap: zero samples after each packet, 16..100000; fewer would keep the last packet waiting for the next
    """

    modulation: Literal["bpsk", "qpsk", "8psk"] = "qpsk"
    sps: Annotated[int, Field(ge=2, le=64)] = 4
    rolloff: Annotated[float, Field(ge=0.2, le=1)] = 0.35
    gap: Annotated[int, Field(ge=16, le=100_000)] = 32


class PskModem(LinearModem):
    """See :class:`PskOptions`."""

    def __init__(self, packet_len: int, options: PskOptions) -> None:
        super().__init__(packet_len, _ORDER[options.modulation], options.sps)
        taps = firdes.root_raised_cosine(1.0, options.sps, 1.0, options.rolloff, _PULSE_SYMBOLS * options.sps + 1)
        pulse = np.array(taps)
        pulse /= np.sqrt((pulse**2).sum())
        self.taps: NDArray[np.float32] = pulse.astype(np.float32)
        self._pulse = pulse * np.sqrt(self.burst_samples / self.symbols)

    @property
    def burst_samples(self) -> int:
        return (self.symbols - 1) * self.sps + len(self.taps)

    def modulate(self, packet: bytes) -> Samples:
        payload = np.exp(2j * np.pi / self.order * self.phases(packet))
        return shape(np.concatenate((self._known, payload)), self._pulse, self.sps).astype(np.complex64)


class PskPhy(BurstPhy):
    """Single carrier for narrow channels without echoes: an echo of a symbol's length is beyond it, take `ofdm` there.

    Carrier offset up to 5 % of the symbol rate, clocks within 100 ppm; packets of 14..4095 B.

    :param options: see :class:`PskOptions`
    :raises ConfigError: for an option that is unknown or out of range
    """

    name = "psk"

    def __init__(self, packet_len: int, sample_rate: float, **options: Any) -> None:
        super().__init__(packet_len, sample_rate)
        self.options = build(PskOptions, options, "phy psk")
        self.modem: PskModem = PskModem(packet_len, self.options)
        self.gap = self.options.gap

    @property
    def receiver_taps(self) -> Any:
        return self.modem.taps

    def burst_power(self) -> float:
        return 1.0

    def computed_pdr(self, snr_db: float) -> float:
        snr = 10 ** (snr_db / 10) * self.modem.burst_samples / self.modem.symbols
        return packet_success(psk_symbol_error(self.modem.order, snr), self.modem.payload_symbols)
