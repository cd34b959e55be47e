"""The `gfsk` PHY: binary frequency-shift keying, Gaussian pulses, modulation index 1/2 (GMSK), constant envelope.

Invariant: the samples sent are those that GNU Radio's ``gfsk_mod`` sends for the same bits (bit 1 is the higher
frequency), so a discriminator can receive them too; this receiver does not use one. At modulation index 1/2 the signal
is, except for a few percent of its energy, a sequence of overlapping pulses whose phase steps by plus or minus 90
degrees (Laurent, IEEE Trans. Commun. 34-2, 1986). It is received coherently, about 4 dB better than by a filter and a
discriminator.
"""

from __future__ import annotations

from itertools import product
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from gr_ros2.phy.burst import Frames, Samples
from gr_ros2.phy.linear import LinearModem, LinearOptions, LinearPhy, Reals, shape
from gr_ros2.phy.preamble import preamble_steps

_PULSE_SYMBOLS = 4
"""Length of the Gaussian frequency pulse."""
_LEAD, _TAIL = 4, _PULSE_SYMBOLS + 2
"""Filler bits around preamble and payload, for the pulses that reach beyond them."""
_TAIL_SIGNS = np.tile([1.0, -1.0], _TAIL // 2)
_DESIGN_NOISE = 0.1
"""Noise over symbol energy for which the receiver's filter is designed: 10 dB."""


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class GfskOptions(LinearOptions):
    """Settings of this PHY beside packet length and sample rate, and those of every burst PHY."""

    bt: Annotated[float, Field(ge=0.3, le=1, title="Bandwidth-time product")] = 0.5
    """bandwidth-time product of the Gaussian filter, 0.3..1; smaller is narrower and needs more SNR"""


class GfskModem(LinearModem):
    """GMSK, received coherently as a sequence of pulses."""

    def __init__(self, frames: Frames, options: GfskOptions) -> None:
        super().__init__(frames, 2, options.sps, turn=np.pi / 2)
        self._pulse = frequency_pulse(options.sps, options.bt)
        self.taps: NDArray[np.float32] = wiener(main_pulse(self._pulse, options.sps), options.sps).astype(np.float32)
        self._head = np.concatenate((np.tile([1.0, -1.0], _LEAD // 2), preamble_steps()))
        self.last_bit = int(np.prod(preamble_steps()) < 0)
        self.head.prepare(self.preamble, self.taps)

    @property
    def symbol_energy(self) -> float:
        return float(self.sps)

    def samples_of(self, packet_len: int) -> int:
        return (_LEAD + self.symbols(packet_len) + _TAIL - 2) * self.sps + len(self._pulse)

    @property
    def preamble(self) -> Samples:
        return self._wave(self._head)

    def modulate(self, packet: bytes) -> Samples:
        data = self.payload_bits(packet)
        if self.frames.coded:
            data = np.uint8(1) ^ data ^ np.concatenate((np.array([self.last_bit], np.uint8), data[:-1]))
        return self._wave(np.concatenate((self._head, 2.0 * data - 1, _TAIL_SIGNS)))

    def waveform(self) -> dict[str, Any]:
        turned = np.cumsum(self._pulse).reshape(_PULSE_SYMBOLS, self.sps)
        sequences = np.array(list(product((0, -1, 1), repeat=_PULSE_SYMBOLS)))
        waves = np.exp(1j * (sequences[:, ::-1] @ turned))
        lead, tail = self._head > 0, _TAIL_SIGNS > 0
        pieces = {"lead": lead, "lead_len": len(lead), "tail": tail, "tail_len": len(tail)}
        return {"pulse": (), "pulse_len": len(self._pulse), "waves": waves, **pieces}

    def _wave(self, signs: Reals) -> Samples:
        """Samples of bits, given as signs."""
        wave: Samples = np.exp(1j * np.cumsum(shape(signs, self._pulse, self.sps))).astype(np.complex64)
        return wave

    @property
    def before_payload(self) -> int | None:
        # A bit is 1 where the phase equals that of the symbol before; before the first bit comes the last symbol of the
        # preamble. With a code the bits are precoded so that the phases themselves are the bits, because errors in
        # pairs would disturb the decoder.
        return None if self.frames.coded else self.last_bit


def frequency_pulse(sps: int, bt: float) -> Reals:
    """Phase steps of one bit, radians per sample; they add up to a quarter turn.

    :param sps: samples per bit
    :param bt: bandwidth-time product
    """
    width = _PULSE_SYMBOLS * sps
    t = (np.arange(width - sps + 1) - (width - sps) / 2) / sps
    gauss = np.exp(-2 * (np.pi * bt * t) ** 2 / np.log(2))
    pulse = np.convolve(gauss, np.ones(sps))
    return np.asarray(pulse * (np.pi / 2 / pulse.sum()))


def main_pulse(pulse: Reals, sps: int) -> Reals:
    """Laurent's first pulse, which carries nearly all energy.

    :param pulse: phase steps of one bit
    """
    length = -(-len(pulse) // sps)
    phase = np.full(length * sps + 1, np.pi / 2)
    phase[: len(pulse)] = np.cumsum(pulse)
    s = np.sin(np.concatenate((phase, np.pi / 2 - phase[1:])))
    out = np.ones((length + 1) * sps)
    for shift in range(length):
        part = s[shift * sps :][: len(out)]
        out[: len(part)] *= part
        out[len(part) :] = 0
    return out


def wiener(pulse: Reals, sps: int) -> Reals:
    """The Wiener filter for symbols of this pulse in noise of ``_DESIGN_NOISE``.

    Every second neighbour is orthogonal to the decision (90 degrees) and does not count. The filter is as long as the
    pulse, so that its tail is over with the burst.
    """
    size = len(pulse)
    energy = float((pulse**2).sum())
    covariance = _DESIGN_NOISE * energy * np.eye(size)
    for at in range(-(size // (2 * sps)) * 2 * sps, size, 2 * sps):
        moved = np.zeros(size)
        moved[max(0, at) : size + min(0, at)] = pulse[max(0, -at) : size - max(0, at)]
        covariance += np.outer(moved, moved)
    taps = np.linalg.solve(covariance, pulse)
    return np.asarray(taps[::-1] / np.sqrt((taps**2).sum()))


class GfskPhy(LinearPhy):
    """For cheap transmitters and nonlinear amplifiers: the envelope is constant while a burst lasts.

    Carrier offset up to 5 % of the bit rate, clocks within 100 ppm; packets of 1..4095 B. The computed curve is that of
    antipodal pulses; GMSK is close to it at a bandwidth-time product of 0.5 (MSK equals it).

    :param options: see :class:`GfskOptions`
    :raises ConfigError: for an option that is unknown or out of range
    """

    name = "gfsk"
    Options = GfskOptions

    def __init__(self, packet_len: int, sample_rate: float, **options: Any) -> None:
        super().__init__(packet_len, sample_rate, **options)
        self.modem = GfskModem(self.frames(), self.options)
