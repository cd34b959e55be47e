"""Single-carrier bursts: phase-shift keying with a known preamble, synchronised feed-forward.

Invariants: a burst is found by correlating the phase steps of its preamble, so carrier offset does not prevent this; it
is accepted only if a single carrier then explains the preamble; frequency, phase and timing of each burst are measured
on its preamble and tracked along its payload in blocks, without a loop that could keep a wrong state from the burst
before; the payload begins with a length word if packets may have different lengths.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import Annotated, Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from gr_ros2.phy.burst import BurstModem, Frames, ModemConstants, Reading, Samples, Search
from gr_ros2.phy.burst_blocks import BurstOptions, BurstPhy
from gr_ros2.phy.fec import Bits, Soft
from gr_ros2.phy.length_word import WORD_BITS, LengthWord
from gr_ros2.phy.soft import Points, spread_about
from gr_ros2.phy.theory import coded_success, packet_success, psk_symbol_error

Reals = NDArray[np.float64]
_T = TypeVar("_T", np.complex128, np.float64)

PREAMBLE = 64
"""Symbols of the preamble: a first one and the 63 phase steps of a maximum-length sequence."""
_SLACK = 4
"""Samples after the last symbol that interpolation and a late start may need."""
_THRESHOLD = 0.31
"""Threshold of the normalised correlation of the phase steps, above which samples are examined closely. Noise alone
passes once in 500; a readable burst has 0.35 with a code, 0.7 without one."""
_ALIKE = 0.28
"""Threshold of the share of the preamble's power in a single carrier; a burst is above it. A readable burst has 0.3;
noise reaches the threshold once in several 10^6 samples."""
_RISE = 16
"""Symbols before its peak at which the correlation of a strong burst may pass the threshold."""
_CHUNK = 256
"""Symbols between two estimates of the timing: clocks may differ by 100 ppm."""
_BLOCK = 64
"""Symbols per estimate of the phase."""
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
        self._turn = turn
        self._steps = preamble_steps().astype(np.float32)
        known = np.concatenate(([1], np.cumprod(preamble_steps()))) * np.exp(1j * turn * np.arange(PREAMBLE))
        self._known = known.astype(np.complex64)

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
        return (PREAMBLE + _RISE) * self.sps

    @property
    def peak_samples(self) -> int:
        return 2 * self.sps

    @property
    def preamble(self) -> Samples:
        """The first samples of every burst, as sent."""
        return shape(self._known, self.pulse, self.sps).astype(np.complex64)

    def samples_of(self, packet_len: int) -> int:
        return (self.symbols(packet_len) - 1) * self.sps + len(self.pulse)

    def modulate(self, packet: bytes) -> Samples:
        return shape(np.concatenate((self._known, self.payload(packet))), self.pulse, self.sps).astype(np.complex64)

    def _prepare_estimate(self) -> None:
        """Compute the preamble after the receive filter, without noise."""
        pause = np.zeros(2 * _RISE * self.sps)
        clean = np.convolve(np.concatenate((pause, self.preamble, pause)), self.taps).astype(np.complex64)
        start = self.find(clean).start
        assert start is not None
        inner = np.arange(_EDGE, PREAMBLE - _EDGE)
        places = start + inner * self.sps
        shifts = [round(half * self.sps / 2) for half in range(-_REACH, _REACH + 1)]
        columns = np.stack([clean[places + shift] for shift in shifts], axis=1) * self._known[inner, None].conj()
        self._clean_energy = float((np.abs(columns[:, _REACH]) ** 2).sum())
        # An error of the measured carrier rotates a column in proportion to its position.
        columns = np.concatenate((columns, columns[:, _REACH : _REACH + 1] * (inner[:, None] - PREAMBLE / 2)), axis=1)
        basis, _ = np.linalg.qr(columns)
        self._explained = np.asarray(basis.conj().T, np.complex64)

    def payload_bits(self, packet: bytes) -> Bits:
        """The length word, if packets may have different lengths, and the frame."""
        wrapped = self.frames.of(len(packet)).wrap(packet)
        return wrapped if self._word is None else np.concatenate((self._word.word(len(packet)), wrapped))

    def payload(self, packet: bytes) -> Samples:
        """The payload's points."""
        return self.constellation.map(self.payload_bits(packet))

    def find(self, samples: Samples) -> Search:
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
            if first + _RISE * sps > positions:  # the maximum may still come
                return Search(first)
            best = first + int(np.argmax(match[first : first + _RISE * sps]))
            if self._carrier(samples, best).alike > _ALIKE:
                return Search(first, best)
            at = int(np.searchsorted(above, best + 1))
        return Search(positions)

    def read(self, samples: Samples, start: int) -> Reading:
        frequency, phase, snr = self._measure(samples, start)
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
        start_exact = start + self._lateness(samples, start, frequency)
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
            "signs": np.empty(0) if self._word is None else self._word.signs,
            "sps": self.sps,
            "order": self.order,
            "point_bits": bits,
            "preamble": PREAMBLE,
            "chunk": _CHUNK,
            "block": _BLOCK,
            "rise": _RISE,
            "edge": _EDGE,
            "slack": _SLACK,
            "unknowns": len(self._explained),
            "differential": before is not None,
            "last_one": self.last_bit,
            "turn": self._turn,
            "clean_energy": self._clean_energy,
            "threshold": _THRESHOLD,
            "alike": _ALIKE,
            "steps": self._steps,
            "known": self._known,
            "explained": self._explained,
            "points": self.constellation.points,
            "marks": self.constellation.marks,
            **self.waveform(),
        }
        return ModemConstants("linear", values, points * bits, points)

    def _measure(self, samples: Samples, start: int) -> tuple[float, float, float]:
        """Carrier frequency and phase from the preamble, in radians per symbol and radians, and SNR.

        The rotation of the modulation counts as carrier frequency here.
        """
        symbols, frequency, _ = self._carrier(samples, start)
        straight = symbols * np.exp(-1j * frequency * np.arange(PREAMBLE))
        return frequency + self._turn, float(np.angle(straight.sum())), self._snr(straight[_EDGE:-_EDGE])

    def _carrier(self, samples: Samples, start: int) -> _Carrier:
        """Examine a preamble closely."""
        size = 4 * PREAMBLE
        symbols = samples[start : start + PREAMBLE * self.sps : self.sps] * self._known.conj()
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

    def _lateness(self, samples: Samples, start: int, frequency: float) -> float:
        """Samples by which the preamble's symbols are later than ``start``, -0.5..0.5."""
        model = self._known.conj() * np.exp(-1j * (frequency - self._turn) * np.arange(PREAMBLE))
        heights = (
            abs((samples[at : at + PREAMBLE * self.sps : self.sps] * model).sum())
            for at in (start - 1, start, start + 1)
        )
        return parabola_peak(*(float(height) for height in heights))


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class LinearOptions(BurstOptions):
    """Settings that every single-carrier PHY has.

    :param sps: samples per symbol, with one bit per symbol samples per bit
    """

    sps: Annotated[int, Field(ge=2, le=64, title="Samples per symbol")] = 4


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


def parabola_peak(before: float, at: float, after: float) -> float:
    """Position of the maximum of the parabola through three neighbours, -0.5..0.5 from the middle one."""
    bend = before - 2 * at + after
    return float(np.clip(0.5 * (before - after) / bend, -0.5, 0.5)) if bend < 0 else 0.0
