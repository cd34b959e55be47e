"""OFDM bursts without GNU Radio's scheduler: detected by a repeated half symbol, demodulated with all symbols as
reference.

Invariants: a detected preamble is a burst only if its two sync words are those of the layout; if packets may have
different lengths, the header carries the length; with an adaptive rate it also carries the MCS, whose modulation and
code the payload has.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from math import sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gr_ros2.phy.burst import CRC_LEN, BurstModem, Frames, ModemConstants, Reading, Samples, Search
from gr_ros2.phy.fec import Bits, Soft
from gr_ros2.phy.length_word import WORD_BITS, LengthWord, header_bits, mcs_mark
from gr_ros2.phy.ofdm_channel import UNSTEADY, ChannelEstimator, ChannelState, Complexes
from gr_ros2.phy.ofdm_layout import HEAD_SYMBOLS, OfdmLayout, constellation
from gr_ros2.phy.soft import Points

_FALSE_ALARM = 1e-3
"""Share of noise samples that are examined closely."""
_ALIKE = 0.2
"""Threshold of the share of the power that arrives over one path; noise passes once in 10^5 examinations."""
_MANY = 256
"""Carriers from which on the phases of the sync words find a burst as well as the energy on one path, which is then not
asked for: in a room a prefix that is laid around one path loses echoes, and more packets with them."""
_SPREAD_ALARM = 2e-7
"""Share of examinations of noise, for each carrier offset tried, in which the carriers of the two sync words are turned
alike. So a burst is found whose energy no single path holds, as in a room."""
_SHIFTS = (-4, -2, 0, 2, 4)
"""Carrier offsets that are tried, in addition to the fractional offset that the repeated half symbol gives."""
_FASTEST = 3.5e-3
"""How much faster or slower than its receiver's clock a burst may pass: sound from a robot that drives at 1.1 m/s."""
_DELAY_STEP = 0.4
"""Samples between two delays of the second sync word that are tried, over the share of carriers that are used."""
_SURE = 8.0
"""Deviations by which a pace must differ from 0: where it does not, reading samples as they are is nearer to the
truth. The deviation itself is estimated from few carriers: with 4, one in 500 packets that nothing delays is lost to it
at any SNR (64 carriers, 1,000 packets at 9.5 to 12 dB)."""
_CHUNK = 16 * 64
"""Carriers of the payload symbols decided together; timing and channel are estimated once for each such group."""
_CLOCKS = 50e-6
"""Deviation of the rates of two clocks from each other, before anything is known of a burst."""
_TINY = 1e-20
_FILL_MARK = 0x555
"""Value added to the number field of a header for each byte that fills up the frame."""
REACH = 12
"""Samples on either side of which a value between two is made."""
FRACTIONS = 512


@cache
def weights() -> NDArray[np.float32]:
    """Of the samples around a place, one row for each fraction of a sample, 0 and 1 included."""
    away = np.arange(-REACH + 1, REACH + 1) - np.arange(FRACTIONS + 1)[:, None] / FRACTIONS
    return np.asarray(np.sinc(away) * np.cos(np.pi * away / (2 * REACH + 2)) ** 2, np.float32)


def stretched(samples: NDArray[np.complex64], first: float, pace: float, count: int) -> NDArray[np.complex64]:
    """``count`` samples from a place on, each ``1 + pace`` after the one before; what is not there is 0."""
    at = first + (1 + pace) * np.arange(count)
    whole = np.floor(at).astype(np.int64)
    rows = weights()[np.rint((at - whole) * FRACTIONS).astype(np.int64)]
    begin, end = int(whole[0]) - REACH + 1, int(whole[-1]) + REACH + 1
    padded = np.zeros(end - begin, np.complex64)
    low, high = max(begin, 0), min(end, len(samples))
    padded[low - begin : max(high, low) - begin] = samples[low : max(high, low)]
    out = np.zeros(count, np.complex64)
    for tap in range(2 * REACH):
        out += rows[:, tap] * padded[whole - begin - REACH + 1 + tap]
    return out


class _FramePlace(NamedTuple):
    """Position of a burst: first sample, carrier offset in radians per sample, whether its sync words are there, and by
    how much its samples are further apart than those of the receiver's clock."""

    begin: int
    frequency: float
    found: bool
    pace: float = 0.0
    delay: float = 0.0
    """Samples by which the second sync word is later than a symbol after the first, and its variance."""
    variance: float = 1.0


class _SymbolClock(NamedTuple):
    """When a burst's symbols come: a Kalman filter of their timing and its rate of change.

    :param begin: position of the burst's first sample
    :param pace: samples by which each symbol is later than the one before
    :param symbol: the symbol up to which both are known
    :param variances: of the timing there, of both together, and of the pace
    """

    begin: float
    pace: float
    symbol: float
    variances: tuple[float, float, float]

    @classmethod
    def first(cls, begin: float, delay: float, variance: float, expected: float) -> _SymbolClock:
        """From the delay of the second sync word.

        :param expected: variance of the pace before anything was measured
        """
        share = expected / (expected + variance)
        # Both words are as late as the channel that they give: their timing is known.
        return cls(begin - share * delay / 2, share * delay, 0.5, (0.0, 0.0, share * variance))

    def after(self, symbol: float, late: float, variance: float) -> _SymbolClock:
        """With the timing of later symbols around ``symbol``, which were ``late``."""
        step = symbol - self.symbol
        own, both, pace = self.variances
        own, both = own + step * (2 * both + step * pace), both + step * pace
        share, turn = own / (own + variance), both / (own + variance)
        faster = self.pace + turn * late
        begin = self.begin + share * late + (self.pace - faster) * symbol
        return _SymbolClock(begin, faster, symbol, ((1 - share) * own, (1 - share) * both, pace - turn * both))


class OfdmModem(BurstModem):
    """Makes and reads OFDM bursts. The reference sample is the first of the first sync word's prefix.

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
        self.constellation = Points(constellation(layout.modulation), "little")
        self._bpsk = Points(np.array([-1, 1], complex), "little")
        self._layout = layout
        self._size, self._prefix, self._symbol = layout.fft_len, layout.cp_len, layout.symbol_samples
        self._half = self._size // 2
        self._window = self._symbol - self._half
        self._level = 1 - _FALSE_ALARM ** (1 / (self._window - 1)) if threshold is None else threshold
        self._back = self._prefix // 4
        self._chunk = _CHUNK // self._size
        self._alike = _ALIKE if self._size < _MANY else 1.0
        self.margin = self._prefix
        self.stretch = max(2048, 16 * self._size)
        self._power = layout.power(frames.bits(frames.packet_len))
        words = np.fft.ifftshift(np.array(layout.sync_words()), axes=1)
        self._channel = channel = ChannelEstimator(layout, words)
        self._carriers, self._data, self._pilots = channel.carriers, channel.data, channel.pilots
        self._known, self._words = channel.known, channel.words
        self._header_mask = layout.header_mask()
        self._prepare_header(mcs)
        self._prepare_search(words)

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
        self._even = even
        self._step = _DELAY_STEP * self._size / len(self._carriers)
        most = int(_FASTEST * self._symbol / self._step)
        self._delays = np.arange(-most, most + 1) * self._step
        """Samples by which the second sync word may be late."""
        self._places = np.fft.fftfreq(self._size) * 2 * np.pi
        """Phase by which a sample turns each carrier."""
        self._advances = np.exp(1j * np.outer(self._delays, self._places)).astype(np.complex64)
        alarm = _SPREAD_ALARM / len(self._delays)
        self._together = sqrt(1 - alarm ** (1 / (len(even) - 1)))
        self._whole = words.conj().astype(np.complex64)
        self._energy = float((np.abs(words) ** 2).sum())

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
            if place.found:
                return Search(max(0, min(first, place.begin)), place.begin)
            at = int(np.searchsorted(above, best + 1))
        return Search(positions)

    def _head(self, rows: Complexes, clock: _SymbolClock) -> tuple[ChannelState, _SymbolClock, int, int]:
        """Evaluates sync words and header: the channel, the timing, the MCS, and the bytes of the packet."""
        all_used = np.ones((1, len(self._data)), bool)
        channel = self._channel.first(rows[:2])
        channel, likely, _, *late = self._channel.decide(rows[2:], channel, self._bpsk, all_used, rounds=1)
        return channel, clock.after(HEAD_SYMBOLS - 1, *late), *self._said(self._bpsk.soft(likely))

    def read(self, samples: Samples, start: int) -> Reading:
        place = self._place(samples, start)
        given, first, step = len(samples), start, 1 + place.pace
        if place.pace:
            first = place.begin
            count = min(int((given - first) / step), self.burst_samples) + self._prefix
            samples = stretched(samples, first - self._prefix * step, place.pace, max(count, 1))
            place = self._look(samples, self._prefix)
        expected = (_CLOCKS * self._symbol) ** 2
        clock = _SymbolClock.first(float(place.begin), place.delay, place.variance, expected)
        rows = self._rows(samples, clock, place.frequency, 0, HEAD_SYMBOLS)
        snr = self._channel.snr(rows[:2], self._power)
        channel, clock, mcs, length = self._head(rows, clock)
        sent = self.rates[mcs]
        end = first + round((sent.samples_of(length) - self._back) * step) + (REACH if step != 1 else 0)
        if end > given:
            return Reading(length, None, samples[:0], snr, end, mcs)
        count = sent.symbols_of(length) - HEAD_SYMBOLS
        points = sent.points_of(length)
        used = np.arange(count * len(self._data)).reshape(count, -1) < points
        soft, looked = [], []
        for at in range(0, count, self._chunk):
            last = min(count, at + self._chunk)
            rows = self._rows(samples, clock, place.frequency, HEAD_SYMBOLS + at, last - at)
            channel, likely, seen, *late = self._channel.decide(rows, channel, sent.constellation, used[at:last])
            soft.append(sent.constellation.soft(likely))
            looked.append(seen)
            clock = clock.after(HEAD_SYMBOLS + (at + last - 1) / 2, *late)
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
            **self._channel.constants(),
            "size": self._size,
            "prefix": self._prefix,
            "repeat": self._repeat,
            "chunk": self._chunk,
            "carrier_count": len(self._carriers),
            "data_count": len(self._data),
            "pilot_count": len(self._pilots),
            "shift_count": len(_SHIFTS),
            "point_counts": [len(each.points) for each in constellations],
            "point_bits": [each.bits for each in constellations],
            "level": self._level,
            "alike": self._alike,
            "together": self._together,
            "even_count": len(self._even),
            "delay_count": len(self._delays),
            "weight_count": 2 * REACH,
            "fractions": FRACTIONS,
            "sure": _SURE,
            "delay_step": self._step,
            "energy": self._energy,
            "power": self._power,
            "clocks": (_CLOCKS * self._symbol) ** 2,
            "unsteady": UNSTEADY**2,
            "carriers": self._carriers,
            "data": self._data,
            "pilots": self._pilots,
            "shifts": _SHIFTS,
            "words": self._words,
            "known": self._known,
            "turns": self._turns,
            "whole": self._whole,
            "points": np.concatenate([each.points for each in constellations]),
            "advances": self._advances,
            "delays": self._delays,
            "weights": weights(),
            "marks": np.concatenate([each.marks.reshape(-1) for each in constellations]),
        }
        soft_bits = max(points * each.bits for points, each in zip(most, constellations, strict=True))
        return ModemConstants("ofdm", values, soft_bits, max(most))

    def _place(self, samples: Samples, at: int) -> _FramePlace:
        """Examine closely a position at which the first half of a symbol is repeated."""
        place = self._look(samples, at)
        if not (place.found and place.pace):
            return place
        # Again as it passes at the pace of this clock, to find its begin and its carriers.
        step = 1 + place.pace
        before, count = 2 * self._prefix, 3 * self._symbol + 2 * self._prefix
        at = max(0, at)
        again = self._look(stretched(samples, at - before * step, place.pace, count), before)
        begin = round(at + (again.begin - before) * step)
        return _FramePlace(begin, again.frequency, again.found, place.pace)

    def _look(self, samples: Samples, at: int) -> _FramePlace:
        """The same at the pace of this clock, and how far the burst's own is from it."""
        at = max(0, at)
        window = samples[at : at + self._window + self._half]
        step = self._repeat * np.vdot(window[: -self._half], window[self._half :])
        frequency = float(np.angle(step)) / self._half
        first = max(0, at + self._prefix - self._back)
        part = samples[first : first + self._symbol + self._size]
        if len(part) < self._symbol + self._size:
            return _FramePlace(at, frequency, False)
        part = part * np.exp(-1j * frequency * np.arange(len(part)))
        spectra = np.fft.fft(np.stack((part[: self._size], part[self._symbol :])))
        tried = np.abs(self._turns @ (self._advances * (spectra[0].conj() * spectra[1])).T)
        row, delayed = divmod(int(np.argmax(tried)), len(self._delays))
        shift = _SHIFTS[row]
        if shift:
            frequency += 2 * np.pi * shift / self._size
            spectra = np.roll(spectra, -shift, axis=1)
            # A carrier shift leaves the rotation of the carriers between the two symbols.
            spectra[1] *= np.exp(-2j * np.pi * shift * self._symbol / self._size)
        gains = spectra * self._whole
        gains[1] *= self._advances[delayed]
        turn = float(np.angle(np.vdot(gains[0], gains[1])))
        pace, delay, variance = self._pace(gains, turn, float(self._delays[delayed]))
        profile = np.abs(np.fft.ifft(gains[0] + gains[1] * np.exp(-1j * turn)))
        products = (gains[1] * gains[0].conj())[self._even]
        peak = int(np.argmax(profile))
        power = float(np.vdot(spectra, spectra).real)
        alike = float((profile[peak] * self._size) ** 2) / max(power * self._energy, _TINY)
        found = alike > self._alike
        if not found:
            # The phases alone, so that a tone does not pass for a burst.
            together = abs((products / (np.abs(products) + _TINY)).sum()) / len(products)
            found = bool(together > self._together)
            # The prefix begins with the paths that together hold the most.
            sums = np.cumsum(np.concatenate(([0], np.tile(profile**2, 2))))
            peak = int(np.argmax(sums[self._prefix :][: self._size] - sums[: self._size])) + self._back
        late = (peak + self._half) % self._size - self._half
        return _FramePlace(first - self._prefix + late, frequency + turn / self._symbol, found, pace, delay, variance)

    def _pace(self, gains: Complexes, turn: float, delay: float) -> tuple[float, float, float]:
        """How much further apart the samples of a burst are, 0 if that may be noise; the delay of its second sync word,
        and its variance.

        :param gains: of both words, the second one advanced by ``delay``
        :param turn: phase between them
        """
        products = ((gains[1] * gains[0].conj()) * np.exp(-1j * turn))[self._even]
        places = self._places[self._even]
        bottom = max(float((places**2) @ np.abs(products.real)), _TINY)
        slope = float(places @ products.imag) / bottom
        rest = products.imag - slope * places * np.abs(products.real)
        variance = float((places**2) @ rest**2) / bottom**2 + UNSTEADY**2
        if not abs(slope) < self._step:
            return 0.0, 0.0, 1.0
        delay -= slope
        return delay / self._symbol if delay**2 > _SURE**2 * variance else 0.0, delay, variance

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
            spectra = spectra * self._channel.advance(late[:, None])
        return np.asarray(spectra, np.complex64)


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
