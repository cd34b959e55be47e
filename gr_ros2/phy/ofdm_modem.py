"""OFDM bursts without GNU Radio's scheduler: detected by a repeated half symbol, demodulated with all symbols as
reference.

Invariants: a detected preamble is a burst only if its two sync words are those of the layout; the channel is a short
impulse response, so its estimate at one carrier uses all carriers; the estimate is tracked through the payload with the
decided payload symbols, weighted by their certainty; if packets may have different lengths, the header carries the
length; with an adaptive rate it also carries the MCS, whose modulation and code the payload has.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gr_ros2.phy.burst import CRC_LEN, BurstModem, Frames, ModemConstants, Reading, Samples, Search
from gr_ros2.phy.fec import Bits, Soft
from gr_ros2.phy.length_word import WORD_BITS, LengthWord, header_bits, mcs_mark
from gr_ros2.phy.ofdm_layout import HEAD_SYMBOLS, OfdmLayout, constellation
from gr_ros2.phy.soft import Points

Complexes = NDArray[np.complexfloating[Any, Any]]
"""Complex numbers of single or double precision."""

_FALSE_ALARM = 1e-3
"""Share of noise samples that are examined closely."""
_ALIKE = 0.2
"""Threshold of the normalised correlation of the sync words; noise passes once in 10^5 examinations."""
_SHIFTS = (-4, -2, 0, 2, 4)
"""Carrier offsets that are tried, in addition to the fractional offset that the repeated half symbol gives."""
_CHUNK = 16
"""Payload symbols decided together; timing and channel are estimated once for each such group."""
_PACE_GAIN = 0.5
"""Gain of the timing loop for the rate of change of the timing."""
_MEMORY = 32.0
"""Symbols over which the channel estimate averages."""
_RIDGE = 0.001
"""Noise over signal per carrier for which the channel estimate is designed."""
_TURN = 0.4
"""Largest error of the carrier offset after the sync words, radians per symbol."""
_DOUBT = 1e-3
"""Share of the power sent: if the uncertainty is below this, symbols are not decided again for a better estimate."""
_TINY = 1e-20
_FILL_MARK = 0x555
"""Value added to the number field of a header for each byte that fills up the frame."""


class _FramePlace(NamedTuple):
    """Position of a burst: first sample, carrier offset in radians per sample, and the share of sync words in the
    power, 0..1."""

    begin: int
    frequency: float
    alike: float


class _SymbolClock(NamedTuple):
    """Position of a burst's first sample, and samples by which each symbol is later than the one before."""

    begin: float
    pace: float


class _Channel(NamedTuple):
    """Gain of each used carrier, the weight of its estimate, and the noise on each carrier."""

    gains: NDArray[np.complex128]
    weight: NDArray[np.float64]
    noise: float


class OfdmModem(BurstModem):
    """See :class:`gr_ros2.phy.ofdm.OfdmOptions`. The reference sample is the first of the first sync word's prefix.

    :param frames: the frames that bursts carry, lowest bit of a byte first
    :param layout: carriers and constellation
    :param threshold: threshold of the preamble's metric, 0..1; None = from the share of false alarms
    :param mcs: with an adaptive rate the number of its MCS, which the header carries; None = a fixed rate
    """

    _counted = True
    """Whether the headers of GNU Radio's blocks, which count frames, are understood."""

    def __init__(self, frames: Frames, layout: OfdmLayout, threshold: float | None, mcs: int | None = None) -> None:
        super().__init__(frames)
        self._threshold = threshold
        self.constellation = Points(np.array(constellation(layout.modulation).points()), "little")
        self._bpsk = Points(np.array([-1, 1], complex), "little")
        self._layout = layout
        self._size, self._prefix, self._symbol = layout.fft_len, layout.cp_len, layout.symbol_samples
        self._half = self._size // 2
        self._window = self._symbol - self._half
        self._level = 1 - _FALSE_ALARM ** (1 / (self._window - 1)) if threshold is None else threshold
        self._back = self._prefix // 4
        self.margin = self._prefix
        self.stretch = max(2048, 16 * self._size)
        self._power = layout.power(frames.bits(frames.packet_len))
        self._carriers = np.array(sorted(layout.data[0] + layout.pilots[0]))
        self._data = np.flatnonzero(np.isin(self._carriers, layout.data[0]))
        self._pilots = np.searchsorted(self._carriers, layout.pilots[0])
        self._known = np.zeros(len(self._carriers), np.complex64)
        self._known[self._pilots] = layout.pilot_symbols[0]
        self._header_mask = layout.header_mask()
        self._prepare_header(mcs)
        words = np.fft.ifftshift(np.array(layout.sync_words()), axes=1)
        self._words = words[:, self._carriers].astype(np.complex64)
        self._twice, self._once = np.flatnonzero(self._words[0]), np.flatnonzero(self._words[0] == 0)
        self._crosswise = self._words[::-1, self._twice]
        self._pair_weight = float((np.abs(self._crosswise) ** 2).sum()) / len(self._twice)
        self._prepare_search(words)
        self._prepare_estimate()

    def _prepare_header(self, mcs: int | None) -> None:
        frames = self.frames
        self._word: LengthWord | None = None
        self.headers: Bits
        """The bits of the headers, one row for each packet length."""
        if frames.fixed:
            self.headers = header_bits([-(-frames.bits(frames.packet_len) // 8)], 0)
            return
        if mcs is None:
            fields = [frames.length(length) for length in frames.lengths]
            marks = [frames.fill(length) * _FILL_MARK for length in frames.lengths]
            self._word = LengthWord(frames.lengths, fields, marks)
        else:
            fields = [length + CRC_LEN for length in frames.lengths]
            self._word = LengthWord(frames.lengths, fields, mcs_mark(mcs))
        self.headers = self._word.bits

    def _header(self, packet_len: int) -> Samples:
        """The header's points."""
        bits = self._header_mask.copy()
        bits[:WORD_BITS] ^= self.headers[packet_len - self.frames.lengths[0]]
        return self._bpsk.map(bits)

    def _word_soft(self, soft: Soft) -> Soft:
        """Soft bits of the word that a header carries."""
        return np.asarray(soft[:WORD_BITS] * (1 - 2.0 * self._header_mask[:WORD_BITS]), np.float32)

    def _said(self, soft: Soft) -> tuple[int, int]:
        """Mcs, and bytes of the packet, from soft bits of the header."""
        return 0, self.frames.packet_len if self._word is None else self._word.read_header(self._word_soft(soft))

    def _prepare_search(self, words: NDArray[np.complex128]) -> None:
        even = np.flatnonzero(np.abs(words[0]) > 0)
        turns = np.zeros((len(_SHIFTS), self._size), np.complex64)
        for row, shift in zip(turns, _SHIFTS, strict=True):
            row[(even + shift) % self._size] = (words[0] * words[1].conj())[even]
        self._turns = turns
        self._repeat = 1 - 2 * int(even[0] % 2)
        """Sign with which the second half of the first sync word repeats the first: its carriers are even or odd."""
        self._whole = words.conj().astype(np.complex64)
        self._energy = float((np.abs(words) ** 2).sum())

    def _prepare_estimate(self) -> None:
        delays = np.arange(self._prefix)
        basis = np.exp(-2j * np.pi * np.outer(self._carriers, delays) / self._size)

        def smoother(weight: NDArray[np.float64]) -> NDArray[np.complex64]:
            gram = basis.conj().T @ (basis * weight[:, None])
            gram += _RIDGE * len(self._carriers) * np.eye(len(delays))
            return np.asarray(basis @ np.linalg.solve(gram, basis.conj().T), np.complex64)

        self._word_weight = (np.abs(self._words) ** 2).sum(axis=0).astype(np.float64)
        self._smooth_words = smoother(self._word_weight)
        self._smooth = smoother(np.ones(len(self._carriers)))
        self._degrees = 2 * len(self._carriers) - len(delays)

    @property
    def rates(self) -> Sequence[OfdmModem]:
        return (self,)

    def symbols_of(self, packet_len: int) -> int:
        """Symbols of the burst of a packet of ``packet_len`` bytes."""
        return self._layout.symbols(self.frames.bits(packet_len))

    def samples_of(self, packet_len: int) -> int:
        return self.symbols_of(packet_len) * self._symbol

    @property
    def span(self) -> int:
        return min(modem.samples_of(self.frames.lengths[0]) for modem in self.rates) - self._back

    @property
    def preamble_samples(self) -> int:
        return 4 * self._symbol

    @property
    def peak_samples(self) -> int:
        return self._symbol

    def modulate(self, packet: bytes) -> Samples:
        symbols = self.symbols_of(len(packet))
        grid = np.zeros((symbols, self._size), np.complex64)
        grid[:2, self._carriers] = self._words
        payload = np.zeros((symbols - 2, len(self._carriers)), np.complex64)
        payload[:] = self._known
        points = np.zeros((symbols - 2, len(self._data)), np.complex64)
        points[0] = self._header(len(packet))
        mapped = self.constellation.map(self.frames.of(len(packet)).wrap(packet))
        points[1:].reshape(-1)[: len(mapped)] = mapped
        payload[:, self._data] = points
        grid[2:, self._carriers] = payload
        bodies = np.fft.ifft(grid) * self._size
        whole = np.concatenate((bodies[:, -self._prefix :], bodies), axis=1)
        return np.asarray(whole.reshape(-1), np.complex64)

    def find(self, samples: Samples) -> Search:
        half, window = self._half, self._window
        # Samples that the close examination of the last position needs, and the same again because it may move.
        positions = len(samples) - 2 * self._symbol - self._prefix
        if positions <= 0:
            return Search(0)
        used = samples[: positions + window + half]
        products = np.cumsum(np.concatenate(([0], used[half:] * used[:-half].conj())), dtype=np.complex128)
        powers = np.cumsum(np.concatenate(([0], used.real**2 + used.imag**2)), dtype=np.float64)
        alike = np.abs(products[window:] - products[:-window])[:positions]
        power = powers[window:] - powers[:-window]
        power = (power[:positions] + power[half : half + positions]) / 2
        above = np.flatnonzero(alike > np.sqrt(self._level) * power + _TINY * (powers[-1] + _TINY))
        at = 0
        while at < len(above):
            first = int(above[at])
            if first + self._symbol > positions:  # the maximum may still come
                return Search(first)
            ratio = alike[first : first + self._symbol] / (power[first : first + self._symbol] + _TINY)
            best = first + int(np.argmax(ratio))
            place = self._place(samples, best)
            if place.alike > _ALIKE:
                return Search(max(0, min(first, place.begin)), place.begin)
            at = int(np.searchsorted(above, best + 1))
        return Search(positions)

    def _head(self, rows: Complexes) -> tuple[_Channel, int, int]:
        """Evaluates sync words and header: the channel, the MCS, and the bytes of the packet."""
        all_used = np.ones((1, len(self._data)), bool)
        channel = self._first_estimate(rows[:2])
        channel, likely, _, _ = self._decide(rows[2:], channel, self._bpsk, all_used, rounds=1)
        return channel, *self._said(self._bpsk.soft(likely))

    def read(self, samples: Samples, start: int) -> Reading:
        begin, frequency, _ = self._place(samples, start)
        clock = _SymbolClock(float(begin), 0.0)
        rows = self._rows(samples, clock, frequency, 0, HEAD_SYMBOLS)
        snr = self._snr(rows[:2])
        channel, mcs, length = self._head(rows)
        sent = self.rates[mcs]
        end = start + sent.samples_of(length) - self._back
        if end > len(samples):
            return Reading(length, None, samples[:0], snr, end, mcs)
        count = sent.symbols_of(length) - HEAD_SYMBOLS
        points = sent.points_of(length)
        used = np.arange(count * len(self._data)).reshape(count, -1) < points
        soft, looked = [], []
        for first in range(0, count, _CHUNK):
            last = min(count, first + _CHUNK)
            rows = self._rows(samples, clock, frequency, HEAD_SYMBOLS + first, last - first)
            channel, likely, seen, late = self._decide(rows, channel, sent.constellation, used[first:last])
            soft.append(sent.constellation.soft(likely))
            looked.append(seen)
            pace = clock.pace + _PACE_GAIN * late / _CHUNK
            clock = _SymbolClock(clock.begin + late + (clock.pace - pace) * (HEAD_SYMBOLS + last), pace)
        return Reading(length, np.concatenate(soft), np.concatenate(looked), snr, end, mcs)

    def points_of(self, packet_len: int) -> int:
        """Payload points of the burst of a packet of ``packet_len`` bytes."""
        return -(-self.frames.bits(packet_len) // self.constellation.bits)

    def constants(self) -> ModemConstants:
        constellations = [modem.constellation for modem in self.rates]
        most = [modem.points_of(modem.frames.packet_len) for modem in self.rates]
        values = {
            **self.lengths(),
            "frame_bits": np.concatenate([modem.lengths()["frame_bits"] for modem in self.rates]),
            "mcs_count": len(self.rates),
            "counted": self._counted,
            "headers": np.concatenate([modem.headers for modem in self.rates]),
            "header_mask": self._header_mask,
            "size": self._size,
            "prefix": self._prefix,
            "repeat": self._repeat,
            "degrees": self._degrees,
            "chunk": _CHUNK,
            "carrier_count": len(self._carriers),
            "data_count": len(self._data),
            "pilot_count": len(self._pilots),
            "once_count": len(self._once),
            "twice_count": len(self._twice),
            "shift_count": len(_SHIFTS),
            "point_counts": [len(each.points) for each in constellations],
            "point_bits": [each.bits for each in constellations],
            "level": self._level,
            "alike": _ALIKE,
            "energy": self._energy,
            "power": self._power,
            "pair_weight": self._pair_weight,
            "word_weight_sum": float(self._word_weight.sum()),
            "pace_gain": _PACE_GAIN,
            "memory": _MEMORY,
            "reach": _TURN,
            "doubt": _DOUBT,
            "carriers": self._carriers,
            "data": self._data,
            "pilots": self._pilots,
            "once": self._once,
            "twice": self._twice,
            "shifts": _SHIFTS,
            "words": self._words,
            "known": self._known,
            "turns": self._turns,
            "whole": self._whole,
            "smooth": self._smooth,
            "smooth_words": self._smooth_words,
            "crosswise": self._crosswise,
            "points": np.concatenate([each.points for each in constellations]),
            "word_weight": self._word_weight,
            "marks": np.concatenate([each.marks.reshape(-1) for each in constellations]),
        }
        soft_bits = max(points * each.bits for points, each in zip(most, constellations, strict=True))
        return ModemConstants("ofdm", values, soft_bits, max(most))

    def _place(self, samples: Samples, at: int) -> _FramePlace:
        """Examine closely a position at which the first half of a symbol is repeated."""
        at = max(0, at)
        window = samples[at : at + self._window + self._half]
        step = self._repeat * np.vdot(window[: -self._half], window[self._half :])
        frequency = float(np.angle(step)) / self._half
        first = max(0, at + self._prefix - self._back)
        part = samples[first : first + self._symbol + self._size]
        if len(part) < self._symbol + self._size:
            return _FramePlace(at, frequency, 0.0)
        part = part * np.exp(-1j * frequency * np.arange(len(part)))
        spectra = np.fft.fft(np.stack((part[: self._size], part[self._symbol :])))
        shift = _SHIFTS[int(np.argmax(np.abs(self._turns @ (spectra[0].conj() * spectra[1]))))]
        if shift:
            frequency += 2 * np.pi * shift / self._size
            spectra = np.roll(spectra, -shift, axis=1)
            # A carrier shift leaves the rotation of the carriers between the two symbols.
            spectra[1] *= np.exp(-2j * np.pi * shift * self._symbol / self._size)
        gains = spectra * self._whole
        turn = float(np.angle(np.vdot(gains[0], gains[1])))
        profile = np.abs(np.fft.ifft(gains[0] + gains[1] * np.exp(-1j * turn)))
        peak = int(np.argmax(profile))
        power = float(np.vdot(spectra, spectra).real)
        alike = float((profile[peak] * self._size) ** 2) / max(power * self._energy, _TINY)
        late = (peak + self._half) % self._size - self._half
        return _FramePlace(first - self._prefix + late, frequency + turn / self._symbol, alike)

    def _rows(
        self, samples: Samples, clock: _SymbolClock, frequency: float, symbol: int, count: int
    ) -> NDArray[np.complex64]:
        """Used carriers of some of a burst's symbols."""
        drift = clock.pace * (symbol + np.arange(count))
        first = round(clock.begin + float(drift[0])) + symbol * self._symbol + self._prefix - self._back
        first = max(0, first)
        part = samples[first : first + (count - 1) * self._symbol + self._size]
        whole = np.zeros(count * self._symbol, np.complex64)
        whole[: len(part)] = part * np.exp(-1j * frequency * (first + np.arange(len(part))))
        spectra = np.fft.fft(whole.reshape(count, -1)[:, : self._size])[:, self._carriers] / self._size
        late = clock.begin + drift - round(clock.begin + float(drift[0]))
        if late.any():
            spectra = spectra * self._advance(late[:, None])
        return np.asarray(spectra, np.complex64)

    def _advance(self, samples: Any) -> NDArray[np.complex128]:
        """Factors that advance carriers by a number of samples, fractional or not."""
        return np.asarray(np.exp(2j * np.pi / self._size * self._carriers * samples))

    def _first_estimate(self, rows: NDArray[np.complex64]) -> _Channel:
        gains = self._smooth_words @ (rows * self._words.conj()).sum(axis=0)
        rest = rows - gains * self._words
        noise = float((np.abs(rest) ** 2).sum()) / self._degrees
        return _Channel(gains, self._word_weight, max(noise, _TINY))

    def _snr(self, rows: NDArray[np.complex64]) -> float:
        """Mean power of a burst over that of the noise in the sampled band, from both sync words.

        The noise is measured on the carriers that the first word leaves empty, and from the difference of both words on
        the others. So it does not depend on the channel.
        """
        first, second = rows[:, self._twice] * self._crosswise
        alike = abs(complex(np.vdot(first, second)))
        differ = float(np.vdot(first, first).real + np.vdot(second, second).real) - 2 * alike
        empty = float(np.vdot(rows[0, self._once], rows[0, self._once]).real)
        noise = max(empty + differ / self._pair_weight, _TINY) / (len(self._carriers) - 0.5)
        signal = float(np.vdot(rows, rows).real) - rows.size * noise
        return signal * self._power / (float(self._word_weight.sum()) * noise * self._size)

    def _decide(
        self, rows: Complexes, channel: _Channel, points: Points, used: NDArray[np.bool_], rounds: int = 2
    ) -> tuple[_Channel, NDArray[np.float32], Samples, float]:
        """Likelihoods of constellation points for some symbols, with a channel estimate improved by these symbols.

        Also returns the delay of the symbols in samples.

        :param used: symbols by data carriers: which of them carry a point
        :param rounds: most rounds of decision and estimation
        """
        gains, noise = channel.gains, channel.noise
        turn = self._tone(rows[:, self._pilots] @ (gains[self._pilots] * self._known[self._pilots]).conj())
        rows = rows * turn[:, None]
        model = np.empty(rows.shape, np.complex64)
        energy = np.ones(rows.shape, np.float32)
        late = 0.0
        for _ in range(rounds):
            likely, _ = self._weigh(rows, gains, noise, points, used)
            expected, squared = points.expected(likely)
            model[:] = self._known
            model[:, self._data] = 0
            model[:, self._data] = _put(expected, used)
            energy[:, self._data] = _put(squared, used)
            turns = rows * (gains * model).conj()
            turn = self._tone(turns.sum(axis=1))
            more = self._late(turn @ turns)
            late += more
            rows = rows * turn[:, None] * self._advance(more)
            weight = np.minimum(channel.weight, _MEMORY)
            total = weight + energy.sum(axis=0)
            gains = self._smooth @ ((weight * channel.gains + (rows * model.conj()).sum(axis=0)) / total)
            if np.vdot(expected, expected).real > (1 - _DOUBT) * squared.sum():
                break
        likely, seen = self._weigh(rows, gains, noise, points, used)
        return _Channel(gains, total, noise), likely, seen, late

    def _weigh(
        self, rows: Complexes, gains: NDArray[np.complex128], noise: float, points: Points, used: NDArray[np.bool_]
    ) -> tuple[NDArray[np.float32], Samples]:
        gains = gains[self._data]
        power = np.abs(gains) ** 2 + _TINY
        seen = (rows[:, self._data] * (gains.conj() / power))[used].astype(np.complex64)
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

    def _late(self, turns: NDArray[np.complex128]) -> float:
        """Delay of symbols in samples, from the phase slope over their carriers."""
        slope = float(self._carriers @ turns.imag) / max(float(self._carriers**2 @ np.abs(turns.real)), _TINY)
        return -slope * self._size / (2 * np.pi)


class AdaptiveOfdmModem(OfdmModem):
    """A modem that reads the bursts of all rates of an adaptive rate, and sends the most robust one.

    :param rates: the modems of the rates, the most robust one first
    """

    _counted = False

    def __init__(self, rates: Sequence[OfdmModem]) -> None:
        first = rates[0]
        super().__init__(first.frames, first._layout, first._threshold, 0)
        self._rates = tuple(rates)
        self._signs = 2 * np.concatenate([modem.headers for modem in rates]).astype(np.float32) - 1

    @property
    def rates(self) -> Sequence[OfdmModem]:
        return self._rates

    def _said(self, soft: Soft) -> tuple[int, int]:
        mcs, row = divmod(int(np.argmax(self._signs @ self._word_soft(soft))), len(self.frames.lengths))
        return mcs, self.frames.lengths[row]


def _put(values: NDArray[np.generic], used: NDArray[np.bool_]) -> NDArray[np.generic]:
    """Values at the used places, zeros elsewhere."""
    out = np.zeros(used.shape, values.dtype)
    out[used] = values
    return out
