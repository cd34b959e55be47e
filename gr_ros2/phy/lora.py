"""The `lora` PHY: chirp spread spectrum similar to LoRa, for links far below the noise.

Invariants: one sample per chip, so the sampled band is the chirp's bandwidth; one packet is one frame; if packets may
have different lengths, chirps before the frame carry its length; the format is our own (it has LoRa's chirps, Gray
code, diagonal interleaver and Hamming code, but CRC-32, PN9 and no header), so it does not communicate with LoRa
modems. With `implementation: lora_sdr` the module gr-lora_sdr determines all of this.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from gr_ros2.core.errors import ConfigError
from gr_ros2.phy.base import BurstCarrier, PacketReceiver, PacketTransceiver, PacketTransmitter
from gr_ros2.phy.burst import CRC_LEN, BurstModem, Frames, ModemConstants, Reading, Samples, Search
from gr_ros2.phy.burst_blocks import STOCK, BurstOptions, BurstPhy
from gr_ros2.phy.fec import Bits, Soft
from gr_ros2.phy.lora_sdr import MAX_PAYLOAD, MAX_SYMBOL, PER_CHIP, SdrFrame, SdrReceiver, SdrTransmitter, load
from gr_ros2.phy.preamble import parabola_peak
from gr_ros2.phy.theory import at_least, coded_orthogonal_success, orthogonal_symbol_error, packet_success
from gr_ros2.settings.fields import AUTO, Auto

MAX_BURST = 1 << 22
"""Most samples of a burst; a longer burst would take more memory than small computers have."""
_UP, _SYNC, _DOWN = 8, (24, 32), 2
"""Symbols of the preamble: plain up-chirps, a sync word, plain down-chirps."""
_HEAD = _UP + len(_SYNC) + _DOWN
_TELLING = 4
"""Number of chirps that carry the length. With fewer, errors in the length would limit the gain of a code."""
_LOOK = 6
"""Up-chirps whose spectra are added to detect a burst."""
_LIMIT, _THRESHOLD = 10.0, 36.0
"""Powers relative to the mean of all bins: the limit for one chirp, and the detection threshold for the sum of a
burst's chirps. A readable burst has 50; noise alone passes once in 10^6 symbols."""
_MEDIAN = (1 - 1 / (9 * _LOOK)) ** 3
"""Median over mean of the noise in a bin after adding ``_LOOK`` chirps (chi-squared distribution)."""
_TINY = 1e-20
_FINE = 4
"""Steps per bin in the search for peaks."""
_CHUNK = 2048
"""Samples between two estimates of the timing, at least a symbol."""
_GAIN, _PACE_GAIN = 0.3, 0.05
"""Gains of the timing loop, per estimate: of the timing, and of its rate of change."""
_CERTAIN = 50.0
"""Largest magnitude of a soft bit."""
_NIBBLE = np.array([8, 4, 2, 1])
"""Weights of a nibble's bits, in the order in which they arrive."""
_SINC = 12
"""Number of samples on either side from which a value between two samples is interpolated."""
_SDR_ONLY = ("sync_word", "ldro", "carrier_hz")
_SDR_GAP, _SDR_LEAST_GAP = 32, 24
"""Default and least gap, chips; filter and synchroniser of the module's receiver delay by 20."""


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class LoraOptions(BurstOptions):
    """Settings of this PHY beside packet length and sample rate, and those of every burst PHY."""

    spreading_factor: Annotated[int, Field(ge=7, le=12, title="Spreading factor (bits/symbol)")] = 7
    """bits per symbol of 2^this samples, 7..12; one more takes twice the time and 2.5 dB less SNR"""
    coding_rate: Annotated[int, Field(ge=1, le=4, title="Coding rate (check bits per 4 bits)")] = 4
    """check bits per 4 bits, 1..4; 3 and 4 correct an error in each code word"""
    implementation: Literal["own", "lora_sdr"] = "own"
    """`lora_sdr` = the frames of LoRa modems, by the module gr-lora_sdr. The same at both ends"""
    sync_word: Annotated[int, Field(ge=0x11, le=0xFF)] | Auto = AUTO
    """``lora_sdr`` only: of the network, 0x11..0xff, no nibble 0; auto = 0x12, private networks"""
    ldro: Annotated[bool | Auto, Field(title="Low data rate optimisation")] = AUTO
    """`lora_sdr` only: low data rate optimisation, two bits fewer per symbol; auto = off"""
    carrier_hz: Annotated[float, Field(ge=1e6, le=4.2e9, title="Carrier frequency (Hz)")] | None = None
    """`lora_sdr` only: carrier frequency, Hz, by which the module tells how much the clocks differ; null = not at
    all"""


class _ChirpPlace(NamedTuple):
    """Position of a burst's payload, carrier offset in bins, and SNR."""

    begin: float
    carrier: float
    snr: float


class LoraModem(BurstModem):
    """Makes and reads bursts of chirps. The reference sample is approximately the first sample of an up-chirp early in
    the preamble."""

    def __init__(self, frames: Frames, options: LoraOptions) -> None:
        super().__init__(frames)
        self.spreading_factor, self.code_bits = options.spreading_factor, 4 + options.coding_rate
        self.chips = 1 << options.spreading_factor
        self._telling = np.empty((0, 0), np.int64) if frames.fixed else telling(frames.lengths, self.chips)
        self._before: int = self._telling.shape[1]
        """Number of chirps between preamble and payload."""
        n = np.arange(self.chips)
        self._up = np.exp(1j * np.pi * (n * n / self.chips - n)).astype(np.complex64)
        self._down = self._up.conj()
        taper = np.hanning(self.chips)
        self._tapered = (taper * self._down).astype(np.complex64)
        self._median_share = 1 / (_LOOK * _MEDIAN * float((taper**2).sum()))
        self._roots = np.exp(2j * np.pi * n / self.chips).astype(np.complex64)
        self._words = code_words(options.coding_rate)
        gray = n ^ n >> 1
        self._ones = [np.flatnonzero(gray >> bit & 1) for bit in range(options.spreading_factor)]
        self._zeros = [np.flatnonzero(~gray >> bit & 1) for bit in range(options.spreading_factor)]
        self.margin = 2 * self.chips

    def blocks(self, packet_len: int) -> int:
        """Blocks of code words of a packet of ``packet_len`` bytes."""
        return -(-self.frames.bits(packet_len) // (4 * self.spreading_factor))

    def symbols(self, packet_len: int) -> int:
        """Chirps of a packet's payload."""
        return self.blocks(packet_len) * self.code_bits

    def samples_of(self, packet_len: int) -> int:
        return (_HEAD + self._before + self.symbols(packet_len)) * self.chips

    @property
    def span(self) -> int:
        # The chirps that carry the length are included, and the samples that interpolation needs.
        return (_HEAD + 1 + (self._before + 1 if self._before else 0)) * self.chips

    @property
    def preamble_samples(self) -> int:
        return (2 * _LOOK + 1) * self.chips

    @property
    def peak_samples(self) -> int:
        return _LOOK * self.chips

    def modulate(self, packet: bytes) -> Samples:
        values = self._spread(self.frames.of(len(packet)).wrap(packet))
        told = self._telling[len(packet) - self.frames.lengths[0]] if self._before else ()
        starts = np.concatenate((np.zeros(_UP, np.int64), _SYNC, told, values)).astype(np.int64)
        chips = (np.arange(self.chips) + starts[:, None]) % self.chips
        ups = self._up[chips]
        head = _UP + len(_SYNC)
        return np.concatenate((ups[:head].reshape(-1), np.tile(self._down, _DOWN), ups[head:].reshape(-1)))

    def find(self, samples: Samples) -> Search:
        count = len(samples) // self.chips
        if count < _LOOK + 1:
            return Search(0)
        powers = np.abs(np.fft.fft(samples[: count * self.chips].reshape(count, -1) * self._down)) ** 2
        mean = powers.mean(axis=1, keepdims=True)
        powers = np.where(np.isfinite(mean), powers / np.maximum(mean, _TINY), 0.0)
        # Neighbouring bins are added: a burst that starts between two samples has its peak in two bins. The power of
        # one chirp is limited to a few times the noise, because data may repeat a value and then end.
        pairs = np.minimum(powers + np.roll(powers, 1, axis=1), _LIMIT)
        # Differences of running sums are not used: strong chirps have equal sums, and rounding would choose among them.
        pairs = np.add.reduce([pairs[first : count - _LOOK + 1 + first] for first in range(_LOOK)])
        above = np.flatnonzero(pairs.max(axis=1) > _THRESHOLD)
        if not len(above):
            return Search((count - _LOOK) * self.chips)
        first = int(above[0])
        if first + _LOOK >= len(pairs):  # a strong burst is detected early; its best position may still come
            return Search(first * self.chips)
        best = first + int(np.argmax(pairs[first : first + _LOOK + 1].max(axis=1)))
        late = int(np.argmax(np.minimum(powers[best : best + _LOOK], _LIMIT).sum(axis=0)))
        return Search(first * self.chips, best * self.chips + (self.chips - late) % self.chips)

    def _end(self, place: _ChirpPlace, length: int) -> int:
        # The end of a burst may be a few samples late, because of the clocks and the channel.
        return round(place.begin) + (self._before + self.symbols(length)) * self.chips - _SINC

    def _tones(self, samples: Samples, place: _ChirpPlace, first: float, count: int) -> NDArray[np.complex64]:
        """``count`` chirps from a position on, as tones, one per row."""
        turn = np.exp(-2j * np.pi * place.carrier * np.arange(self.chips) / self.chips) * self._down
        rows = _delayed(samples, first, count * self.chips).reshape(count, self.chips)
        return np.asarray(rows * turn, np.complex64)

    def _length(self, samples: Samples, place: _ChirpPlace) -> int:
        """Bytes of the packet."""
        if not self._before:
            return self.frames.packet_len
        heights = np.abs(np.fft.fft(self._tones(samples, place, place.begin, self._before)))
        likely = heights[np.arange(self._before), self._telling].sum(axis=1)
        return self.frames.lengths[0] + int(np.argmax(likely))

    def read(self, samples: Samples, start: int) -> Reading | None:
        place = self._place(samples, start)
        if place is None:
            return None
        length = self._length(samples, place)
        end = self._end(place, length)
        if end > len(samples):
            return Reading(length, None, samples[:0], place.snr, end)
        symbols = self.symbols(length)
        begin = place.begin + self._before * self.chips
        soft = np.empty((symbols, self.spreading_factor), np.float32)
        points = np.empty(symbols, np.complex64)
        step = max(1, _CHUNK // self.chips)
        pace = 0.0
        for first in range(0, symbols, step):
            count = min(step, symbols - first)
            tones = self._tones(samples, place, begin + first * self.chips, count)
            spectrum = np.fft.fft(tones)
            heights = np.abs(spectrum)
            peaks = np.argmax(heights, axis=1)
            points[first : first + count] = spectrum[np.arange(count), peaks] / max(float(heights.max()), _TINY)
            soft[first : first + count] = self._soft(heights)
            late = self._late(tones, peaks)
            pace -= _PACE_GAIN * late
            begin += pace - _GAIN * late
        return Reading(length, self._collect(soft), points, place.snr, end)

    def constants(self) -> ModemConstants:
        symbols = self.symbols(self.frames.packet_len)
        values = {
            **self.lengths(),
            "telling": self._telling,
            "before": self._before,
            "chips": self.chips,
            "spreading_factor": self.spreading_factor,
            "code_bits": self.code_bits,
            "step": max(1, _CHUNK // self.chips),
            "look": _LOOK,
            "head": _HEAD,
            "sync": len(_SYNC),
            "down": _DOWN,
            "fine": _FINE,
            "sinc": _SINC,
            "median_share": self._median_share,
            "limit": _LIMIT,
            "threshold": _THRESHOLD,
            "gain": _GAIN,
            "pace_gain": _PACE_GAIN,
            "certain": _CERTAIN,
            "down_chirp": self._down,
            "up_chirp": self._up,
            "tapered": self._tapered,
            "words": self._words,
            "sync_word": _SYNC,
        }
        return ModemConstants("lora", values, self.blocks(self.frames.packet_len) * self.spreading_factor * 4, symbols)

    def _soft(self, heights: NDArray[np.float64]) -> Soft:
        """Log-likelihood ratios of the bits of chirps, from the height of each bin."""
        powers = (heights**2).sum(axis=1)
        peaks = heights.max(axis=1)
        noise = max(float((powers - peaks**2).mean()) / (self.chips - 1), _TINY)
        # For a bin of height h, and amplitude a if its chirp was sent, log I0(2 a h / noise) is about 2 a h / noise.
        likely = heights * (2 * peaks.mean() / noise)
        bits = [likely[:, ones].max(1) - likely[:, zeros].max(1)
                for ones, zeros in zip(self._ones, self._zeros, strict=True)]  # fmt: skip
        # Without a limit, very certain bits would hide the bits of noisier chirps in the same code word.
        return np.asarray(np.clip(np.stack(bits, axis=1), -_CERTAIN, _CERTAIN), np.float32)

    def _late(self, tones: NDArray[np.complex64], peaks: NDArray[np.int64]) -> float:
        """Samples by which windows are later than their chirps, -0.5..0.5.

        This is more than the distance of a tone from its bin: where a chirp jumps back by the whole band, a delay
        rotates the phase. A delay rotates each sample by the chirp's frequency at that sample.
        """
        n = np.arange(self.chips)
        still = tones * self._roots[peaks[:, None] * -n % self.chips]
        frequency = (n + peaks[:, None]) % self.chips / self.chips - 0.5
        whole, part = still.sum(axis=1), (still * frequency).sum(axis=1)
        power = float((np.abs(whole) ** 2).sum())
        turned = float((part * whole.conj()).imag.sum())
        return float(np.clip(turned * 6 / (np.pi * max(power, _TINY)), -0.5, 0.5))

    def _place(self, samples: Samples, start: int) -> _ChirpPlace | None:
        """Examine a preamble closely; None if it is not a burst."""
        windows = samples[start : start + (_HEAD + 1) * self.chips]
        windows = windows[: len(windows) // self.chips * self.chips].reshape(-1, self.chips)
        falls = self._powers(windows, self._up)
        if len(falls) < 2 or not np.isfinite(falls.sum()):
            return None
        pairs = falls[:-1] + falls[1:]
        at = int(np.argmax(pairs.max(axis=1)))
        if at < len(_SYNC) + 1:
            return None
        fall = self._bin(pairs[at])
        rise = self._bin(self._powers(windows[: at - len(_SYNC)], self._down).sum(axis=0))
        # A delay moves up-chirps and down-chirps in opposite directions, a carrier offset in the same direction.
        begin = start + (at + _DOWN) * self.chips + round((fall - rise) / 2)
        # Repeat it with windows aligned to the chirps: between two chirps a fraction of a sample rotates the phase.
        first = begin - (_DOWN + len(_SYNC) + _LOOK) * self.chips
        if first < 0 or begin > len(samples):
            return None
        windows = samples[first:begin].reshape(-1, self.chips)
        rises = self._powers(windows[:_LOOK], self._down).sum(axis=0)
        rise = self._bin(rises)
        fall = self._bin(self._powers(windows[-_DOWN:], self._up).sum(axis=0))
        snr = self._snr(windows[:_LOOK], float(rises.max()))
        return _ChirpPlace(begin + (fall - rise) / 2, (fall + rise) / 2, snr)

    def _snr(self, chirps: Samples, top: float) -> float:
        """Power of a burst over that of the noise.

        :param chirps: its up-chirps
        :param top: maximum of the sum of their spectra
        """
        # A window function, since a chirp between two samples has a jump whose power is in all bins; the median, since
        # an echo has its own bin.
        powers = (np.abs(np.fft.fft(chirps * self._tapered)) ** 2).sum(axis=0)
        noise = max(float(np.median(powers)) * self._median_share, _TINY)
        return (top / (_LOOK * self.chips) - noise) / (noise * self.chips)

    def _powers(self, windows: Samples, chirp: Samples) -> NDArray[np.float64]:
        """Spectra of windows multiplied with a chirp, ``_FINE`` values per bin."""
        return np.asarray(np.abs(np.fft.fft(windows * chirp, _FINE * self.chips)) ** 2)

    def _bin(self, powers: NDArray[np.float64]) -> float:
        """Position of the maximum of such a spectrum, in bins on either side of 0."""
        top = int(np.argmax(powers))
        place = (top + parabola_peak(powers[top - 1], powers[top], powers[(top + 1) % len(powers)])) / _FINE
        return (place + self.chips / 2) % self.chips - self.chips / 2

    def _spread(self, bits: Bits) -> NDArray[np.int64]:
        """Bits to chirp starts: Hamming code, diagonal interleaver, Gray code."""
        sf = self.spreading_factor
        filled = np.zeros(-(-len(bits) // (sf * 4)) * sf * 4, np.int64)
        filled[: len(bits)] = bits
        words = self._words[filled.reshape(-1, 4) @ _NIBBLE].reshape(-1, sf)
        coded = (words[:, :, None] >> np.arange(self.code_bits)) & 1
        rows = (np.arange(sf)[None, :] + np.arange(self.code_bits)[:, None]) % sf
        mixed = coded[:, rows, np.arange(self.code_bits)[:, None]]
        out: NDArray[np.int64] = mixed.reshape(-1, sf) @ (1 << np.arange(sf))
        for shift in (1, 2, 4, 8):
            out ^= out >> shift
        return out

    def _collect(self, soft: Soft) -> Soft:
        """Soft bits of chirps to those of the frame, through the likeliest code words."""
        sf = self.spreading_factor
        mixed = soft.reshape(-1, self.code_bits, sf)
        rows = (np.arange(sf)[None, :] + np.arange(self.code_bits)[:, None]) % sf
        coded = np.empty((len(mixed), sf, self.code_bits), np.float32)
        coded[:, rows, np.arange(self.code_bits)[:, None]] = mixed
        signs = 2.0 * (self._words[:, None] >> np.arange(self.code_bits) & 1) - 1
        likely = coded.reshape(-1, self.code_bits) @ (signs.T / 2).astype(np.float32)
        marks = (np.arange(16)[:, None] & _NIBBLE) > 0
        bits = [likely[:, mark].max(1) - likely[:, ~mark].max(1) for mark in marks.T]
        return np.asarray(np.stack(bits, axis=1).reshape(-1), np.float32)


@lru_cache
def code_words(check_bits: int) -> NDArray[np.int64]:
    """The 16 code words of 4 data bits and ``check_bits`` check bits; with 3 check bits any two differ in 3 bits, with
    4 in 4."""
    data = np.arange(16)
    d = [(data >> i) & 1 for i in range(4)]
    parity = d[0] ^ d[1] ^ d[2] ^ d[3]
    checks = [d[0] ^ d[1] ^ d[2], d[1] ^ d[2] ^ d[3], d[0] ^ d[1] ^ d[3], d[0] ^ d[2] ^ d[3]]
    chosen = [parity] if check_bits == 1 else checks[:check_bits]
    return np.asarray(data + sum((bit << 4 + i) for i, bit in enumerate(chosen)))


def telling(lengths: range, chips: int) -> NDArray[np.int64]:
    """Start positions of the four chirps that carry a length, one length per row. Any two lengths differ in at least
    three of the four.

    Two lengths below the number of chips differ in all four. Neighbouring lengths differ in opposite directions, so a
    carrier error of one bin does not change one length into another.

    :param lengths: bytes, below 32 times ``chips``
    :param chips: chips of a chirp, 128 or more
    """
    high, low = np.divmod(np.array(lengths), chips)
    ways = np.array([1, -1, 1, -1])[:_TELLING]
    return np.asarray((low[:, None] * ways + high[:, None] * np.arange(_TELLING)) % chips)


def _delayed(samples: Samples, at: float, count: int) -> Samples:
    """``count`` samples from a fractional position on, by a windowed sinc; zeros after the end."""
    base = int(np.floor(at))
    x = np.arange(-_SINC + 1, _SINC + 1) - (at - base)
    taps = np.sinc(x) * np.cos(np.pi * x / (2 * _SINC + 2)) ** 2
    part = samples[base - _SINC + 1 : base + _SINC + count]
    missing = 2 * _SINC - 1 + count - len(part)
    if missing:
        part = np.concatenate((part, np.zeros(missing, np.complex64)))
    return np.convolve(part, taps[::-1].astype(np.float32), "valid")


class LoraPhy(BurstPhy):
    """For links far below the noise, at a low rate: half of all packets of 64 B arrive at -11 dB with factor 7.

    Carrier offset up to a tenth of the band, clocks within 60 ppm with factor 7, 15 ppm with 12. One packet is one
    frame, however long, as long as it has at most 2^22 samples: 4095 B with spreading factor 9 and below, 767 B with 12
    (with 4 check bits); with ``lora_sdr`` 251 B.

    :param options: see :class:`LoraOptions`
    :raises ConfigError: for an option that is unknown or out of range, or a packet that is too long
    :raises BackendMissingError: for ``lora_sdr`` where gr-lora_sdr is not installed
    """

    name = "lora"
    Options = LoraOptions

    def __init__(self, packet_len: int, sample_rate: float, **options: Any) -> None:
        super().__init__(packet_len, sample_rate, **options)
        chosen: LoraOptions = self.options
        self._sdr: SdrFrame | None = None
        if chosen.implementation == "lora_sdr":
            self._sdr = self._checked_sdr()
            self.gap = self._sdr.gap
            return
        for name in _SDR_ONLY:
            if getattr(chosen, name) != getattr(LoraOptions, name):
                raise ConfigError(f"phy lora: {name} = {getattr(chosen, name)}: only with implementation = lora_sdr")
        self.modem: LoraModem = LoraModem(self.frames(), chosen)
        if self.modem.burst_samples > MAX_BURST:
            raise ConfigError(
                f"phy lora: packet_len = {packet_len} with spreading_factor = {chosen.spreading_factor}: a burst "
                f"of {self.modem.burst_samples} samples is above {MAX_BURST}; take a smaller one of either"
            )

    def _checked_sdr(self) -> SdrFrame:
        chosen = self.options
        if chosen.fec != "none":
            raise ConfigError(
                f"phy lora: fec = {chosen.fec!r}: gr-lora_sdr gives no soft bits; take implementation = own"
            )
        if self.packet_len > MAX_PAYLOAD - CRC_LEN:
            raise ConfigError(
                f"phy lora: packet_len = {self.packet_len}: at most {MAX_PAYLOAD - CRC_LEN} with lora_sdr; "
                f"a LoRa frame has {MAX_PAYLOAD} bytes, {CRC_LEN} of them our CRC-32"
            )
        sync_word = 0x12 if chosen.sync_word == AUTO else chosen.sync_word
        if not sync_word & 0x0F:
            raise ConfigError(f"phy lora: sync_word = 0x{sync_word:02x}: the module takes no digit of 0")
        gap = _SDR_GAP * PER_CHIP if chosen.gap == AUTO else chosen.gap
        if gap < _SDR_LEAST_GAP * PER_CHIP:
            raise ConfigError(
                f"phy lora: gap = {gap}: below {_SDR_LEAST_GAP * PER_CHIP} the last packet stays in gr-lora_sdr"
            )
        if PER_CHIP << chosen.spreading_factor > MAX_SYMBOL:
            raise ConfigError(
                f"phy lora: spreading_factor = {chosen.spreading_factor}: gr-lora_sdr crashes with symbols above "
                f"{MAX_SYMBOL} samples; take a smaller one, or implementation = own"
            )
        load()
        return SdrFrame(
            packet_len=self.packet_len,
            spreading_factor=chosen.spreading_factor,
            coding_rate=chosen.coding_rate,
            sync_word=sync_word,
            ldro=chosen.ldro is True,
            gap=gap,
            carrier=None if chosen.carrier_hz is None else chosen.carrier_hz * PER_CHIP / self.sample_rate,
        )

    @property
    def any_length(self) -> bool:
        return self._sdr is None and super().any_length

    def airtime_samples(self, packet_len: int | None = None) -> int:
        return super().airtime_samples(packet_len) if self._sdr is None else self._sdr.airtime_samples

    def burst_power(self) -> float:
        return 1.0

    def computed_pdr(self, snr_db: float) -> float:
        """A block of code words is right if no symbol is wrong, or one where the Hamming code corrects an error.

        This holds for hard decisions, and is pessimistic: two wrong symbols may affect different code words.
        """
        chips, check_bits = 1 << self.options.spreading_factor, self.options.coding_rate
        samples = chips if self._sdr is None else self._sdr.symbol_samples
        wrong = orthogonal_symbol_error(chips, 10 ** (snr_db / 10) * samples)
        lost = at_least(2 if check_bits >= 3 else 1, 4 + check_bits, wrong)
        if self._sdr is not None:
            return (1 - at_least(2, 8, wrong)) * packet_success(lost, self._sdr.blocks)
        modem, length = self.modem, self.packet_len
        if modem.frames.coded:
            return coded_orthogonal_success(chips, wrong, modem.frames.data_bits(length), modem.symbols(length))
        return packet_success(lost, modem.blocks(length))

    def runs_on(self) -> str:
        return super().runs_on() if self._sdr is None else STOCK

    def leaves_tags(self) -> bool:
        return self._sdr is not None

    def transmitter(self) -> PacketTransmitter:
        return super().transmitter() if self._sdr is None else SdrTransmitter(self._sdr)

    def receiver(self) -> PacketReceiver:
        return super().receiver() if self._sdr is None else SdrReceiver(self._sdr)

    def transceiver(self, carrier: BurstCarrier) -> PacketTransceiver | None:
        return super().transceiver(carrier) if self._sdr is None else None
