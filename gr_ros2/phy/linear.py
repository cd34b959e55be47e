"""Single-carrier bursts: phase-shift keying with a known preamble, synchronised feed-forward.

Invariants: frequency, phase and timing of each burst are measured on its preamble (:mod:`gr_ros2.phy.preamble`) and
tracked along its payload in blocks, without a loop that could keep a wrong state from the burst before; the payload
begins with a length word if packets may have different lengths.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import Annotated, Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from gr_ros2.phy.burst import BurstModem, Frames, ModemConstants, Reading, Samples, Search
from gr_ros2.phy.burst_blocks import BurstOptions, BurstPhy
from gr_ros2.phy.fec import Bits, Soft
from gr_ros2.phy.length_word import WORD_BITS, LengthWord
from gr_ros2.phy.preamble import PREAMBLE, RISE, Preamble, parabola_peak
from gr_ros2.phy.soft import Points, spread_about
from gr_ros2.phy.theory import coded_success, packet_success, psk_symbol_error

Reals = NDArray[np.float64]
_T = TypeVar("_T", np.complex128, np.float64)

_SLACK = 4
"""Samples after the last symbol that interpolation and a late start may need."""
_CHUNK = 256
"""Symbols between two estimates of the timing: clocks may differ by 100 ppm."""
_BLOCK = 64
"""Symbols per estimate of the phase."""


class LinearModem(BurstModem):
    """Bursts whose matched-filtered samples hold one phase of ``order`` per symbol.

    Samples to :meth:`find` and :meth:`read` have passed a filter with :attr:`taps`. The reference sample is that
    of the preamble's first symbol.

    :param frames: the frames that bursts carry
    :param order: number of phases, a power of 2
    :param sps: samples per symbol, 2 or more
    :param turn: phase step of the modulation in addition to data and carrier, radians per symbol
    """

    stretch = 2048

    def __init__(self, frames: Frames, order: int, sps: int, turn: float = 0.0) -> None:
        super().__init__(frames)
        self.order, self.sps = order, sps
        gray = np.arange(order) ^ np.arange(order) >> 1
        self.constellation = Points(np.exp(2j * np.pi / order * np.argsort(gray)), "big")
        self._word = None if frames.fixed else LengthWord(frames.lengths, frames.lengths)
        self.margin = sps + _SLACK
        self.head = Preamble(sps, turn)

    taps: Samples | NDArray[np.float32]
    """The receiver's filter."""
    pulse: Reals
    """A symbol as sent; not used with frequency modulation."""

    @property
    @abstractmethod
    def symbol_energy(self) -> float:
        """Energy of a symbol, in units of the mean power of a burst."""

    def payload_symbols(self, packet_len: int) -> int:
        """Symbols after the preamble in the burst of a packet of ``packet_len`` bytes."""
        word = 0 if self._word is None else WORD_BITS
        return -(-(word + self.frames.bits(packet_len)) // self.constellation.bits)

    def symbols(self, packet_len: int) -> int:
        """Symbols of the burst of a packet of ``packet_len`` bytes."""
        return PREAMBLE + self.payload_symbols(packet_len)

    @property
    def span(self) -> int:
        return self._needed(self.frames.lengths[0])

    def _needed(self, packet_len: int) -> int:
        """Samples from the reference sample on that are needed to read a packet of ``packet_len`` bytes."""
        return (self.symbols(packet_len) - 1) * self.sps + 1 + _SLACK

    @property
    def preamble_samples(self) -> int:
        return (PREAMBLE + RISE) * self.sps

    @property
    def peak_samples(self) -> int:
        return 2 * self.sps

    @property
    def preamble(self) -> Samples:
        """The first samples of every burst, as sent."""
        return shape(self.head.known, self.pulse, self.sps).astype(np.complex64)

    def samples_of(self, packet_len: int) -> int:
        return (self.symbols(packet_len) - 1) * self.sps + len(self.pulse)

    def modulate(self, packet: bytes) -> Samples:
        return shape(np.concatenate((self.head.known, self.payload(packet))), self.pulse, self.sps).astype(np.complex64)

    def payload_bits(self, packet: bytes) -> Bits:
        """The length word, if packets may have different lengths, and the frame."""
        wrapped = self.frames.of(len(packet)).wrap(packet)
        return wrapped if self._word is None else np.concatenate((self._word.word(len(packet)), wrapped))

    def payload(self, packet: bytes) -> Samples:
        """The payload's points."""
        return self.constellation.map(self.payload_bits(packet))

    def find(self, samples: Samples) -> Search:
        return self.head.find(samples)

    def read(self, samples: Samples, start: int) -> Reading:
        frequency, phase, snr = self.head.measure(samples, start)
        length, skipped = self.frames.packet_len, 0
        if self._word is not None:
            length, skipped = self._length(samples, start, frequency, phase), WORD_BITS
        end = start + self._needed(length)
        if end > len(samples):
            return Reading(length, None, samples[:0], snr, end)
        points, soft = self._payload(samples, start, frequency, phase, self.payload_symbols(length))
        return Reading(length, soft[skipped:], points, snr, end)

    def _length(self, samples: Samples, start: int, frequency: float, phase: float) -> int:
        """Bytes of the packet, from the symbols that even the shortest burst has."""
        assert self._word is not None
        symbols = self.payload_symbols(self.frames.lengths[0])
        _, soft = self._payload(samples, start, frequency, phase, symbols)
        return self._word.read(soft)

    def _payload(
        self, samples: Samples, start: int, frequency: float, phase: float, symbols: int
    ) -> tuple[Samples, Soft]:
        """The first ``symbols`` points of the payload, and their soft bits."""
        sps, order = self.sps, self.order
        late = 0.0
        start_exact = start + self.head.lateness(samples, start, frequency)
        points = np.empty(symbols, np.complex64)
        known_at, known = float(PREAMBLE - 1) / 2, 0.0
        for first in range(0, symbols, _CHUNK):
            count = min(_CHUNK, symbols - first)
            places = first + PREAMBLE + np.arange(count)
            at = start_exact + late + (first + PREAMBLE) * sps
            turned = np.exp(-1j * (phase + frequency * places))
            raw = _at(samples, at, sps, count) * turned
            edges = np.arange(0, max(1, count // _BLOCK)) * _BLOCK
            raised = np.add.reduceat(np.abs(raw) * np.exp(1j * order * np.angle(raw)), edges)
            centres = first + PREAMBLE + (edges + np.append(edges[1:], count) - 1) / 2
            drift = np.unwrap(np.concatenate(([known * order], np.angle(raised))))[1:] / order
            drift = np.interp(places, np.concatenate(([known_at], centres)), np.concatenate(([known], drift)))
            straight = (raw * np.exp(-1j * drift)).astype(np.complex64)
            points[first : first + count] = straight
            known_at, known = float(places[-1]), float(drift[-1])
            if first + count < symbols:
                model = turned * np.exp(-1j * drift) * self.constellation.nearest(straight).conj()
                late += parabola_peak(
                    *(float((_at(samples, at + off, sps, count) * model).real.sum()) for off in (-1, 0, 1))
                )
        decided = self.constellation.nearest(points)
        gain, noise = spread_about(points, decided)
        likely = self.constellation.weigh(points / np.float32(gain), noise / gain**2)
        return points / np.float32(gain), self.meant(self.constellation.soft(likely))

    last_bit = 0
    """The last bit of the preamble, where its symbols are bits."""

    def waveform(self) -> dict[str, Any]:
        """The constants that describe how symbols become samples: ``pulse`` of a symbol, or, with frequency modulation,
        ``waves`` of every sequence of bits (0 = none, 1 = a zero, 2 = a one, the newest one last) as long as the pulse,
        and the bits before (``lead``) and after (``tail``) the payload."""
        unused = {"waves": (), "lead": (), "lead_len": 0, "tail": (), "tail_len": 0}
        return {"pulse": self.pulse, "pulse_len": len(self.pulse), **unused}

    @property
    def before_payload(self) -> int | None:
        """The last bit before the payload where a bit of the frame says whether the phase stays (differential); None
        where the bit is the phase."""
        return None

    def meant(self, soft: Soft) -> Soft:
        """Soft bits of the frame from the soft bits of the phases: equal unless the modulation has memory."""
        if self.before_payload is None:
            return soft
        certain = np.float32(np.inf if self.before_payload else -np.inf)
        before = np.concatenate(([certain], soft[:-1]))
        return np.asarray(np.sign(soft) * np.sign(before) * np.minimum(np.abs(soft), np.abs(before)), np.float32)

    def constants(self) -> ModemConstants:
        bits, points = self.constellation.bits, self.payload_symbols(self.frames.packet_len)
        before = self.before_payload
        values = {
            **self.lengths(),
            **self.head.constants(),
            "signs": np.empty(0) if self._word is None else self._word.signs,
            "sps": self.sps,
            "order": self.order,
            "point_bits": bits,
            "chunk": _CHUNK,
            "block": _BLOCK,
            "slack": _SLACK,
            "differential": before is not None,
            "last_one": self.last_bit,
            "points": self.constellation.points,
            "marks": self.constellation.marks,
            **self.waveform(),
        }
        return ModemConstants("linear", values, points * bits, points)


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class LinearOptions(BurstOptions):
    """Settings that every single-carrier PHY has."""

    sps: Annotated[int, Field(ge=2, le=64, title="Samples per symbol")] = 4
    """samples per symbol, with one bit per symbol samples per bit"""


class LinearPhy(BurstPhy):
    """A PHY of single-carrier bursts, whose mean power is 1."""

    Options = LinearOptions
    modem: LinearModem

    @property
    def receiver_taps(self) -> Any:
        return self.modem.taps

    def burst_power(self) -> float:
        return 1.0

    def computed_pdr(self, snr_db: float) -> float:
        snr = 10 ** (snr_db / 10) * self.modem.symbol_energy
        frames = self.modem.frames
        bits = frames.bits(self.packet_len)
        if frames.coded:
            points = self.modem.constellation.points
            return coded_success(points, snr, frames.data_bits(self.packet_len), bits)
        return packet_success(psk_symbol_error(self.modem.order, snr), -(-bits // self.modem.constellation.bits))


def shape(symbols: NDArray[_T], taps: Reals, sps: int) -> NDArray[_T]:
    """One pulse per symbol, ``sps`` samples apart: (symbols - 1) * sps + taps samples."""
    out = np.zeros((len(symbols) - 1) * sps + len(taps), symbols.dtype)
    for phase in range(sps):
        part = np.convolve(symbols, taps[phase::sps])
        out[phase::sps][: len(part)] += part
    return out


def _at(samples: Samples, at: float, step: int, count: int) -> NDArray[np.complex64]:
    """``count`` values ``step`` samples apart, from a fractional position on, by cubic interpolation."""
    base = int(np.floor(at))
    x = at - base
    weights = (-x * (x - 1) * (x - 2) / 6, (x + 1) * (x - 1) * (x - 2) / 2, -(x + 1) * x * (x - 2) / 2,
               (x + 1) * x * (x - 1) / 6)  # fmt: skip
    total = np.zeros(count, np.complex64)
    for offset, weight in zip((-1, 0, 1, 2), weights, strict=True):
        part = samples[base + offset :: step][:count]
        total[: len(part)] += np.float32(weight) * part
    return total
