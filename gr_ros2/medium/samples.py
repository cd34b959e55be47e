"""The medium at samples: every receiver gets the sum of the bursts that reach it, and noise.

For the burst modems of this package, which need no flowgraph. Each burst reaches a receiver with the gain, the phase,
the echoes, the fading, the carrier offset and the clock of its path.

Invariants: one sample clock for all robots; noise is set from the mean power of the longest packet's burst, as in
:mod:`gr_ros2.phy.channel`; while a robot sends on a shared channel its receiver gets noise alone; samples that no burst
reaches are not computed, except for as many before a burst as a receiver needs to be rid of the one before; equal seeds
give equal samples.
"""

from __future__ import annotations

import heapq
import math
from collections import deque
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from gr_ros2.medium.base import Medium, Path, PathsAt, Reception, Transmission
from gr_ros2.medium.fading import RayleighFading
from gr_ros2.phy import Phy
from gr_ros2.phy.burst import BurstModem, Heard
from gr_ros2.settings.config import ChannelConfig

Samples = NDArray[np.complex64]
Wide = NDArray[np.complex128]

_FADING_STEPS = 64
"""Values of a fading gain computed per reciprocal of the Doppler shift; those between are interpolated."""
_SINC_HALF = 16
"""Samples on each side from which a value between two samples is computed, where clocks differ."""
_MARGIN = 256
"""Samples of noise before a burst, in addition to the modem's preamble."""


class _Burst:
    """A burst as it reaches one receiver.

    :param start: sample at which it begins
    :param packet: what it is a burst of
    """

    def __init__(self, packet: Transmission, path: Path, start: int, samples: Samples) -> None:
        self.packet, self.path, self.start, self.samples = packet, path, start, samples
        self.end = start + len(samples)


class _Ear:
    """One robot's receiver and what is on the air around it."""

    def __init__(self, phy: Phy, modem: BurstModem, noise: np.random.Generator) -> None:
        self._receiver = modem.receiver()
        self._noise = noise
        self._taps = None if phy.receiver_taps is None else np.asarray(phy.receiver_taps, np.float32)
        self._tail = np.zeros(0 if self._taps is None else len(self._taps) - 1, np.complex64)
        self._power = phy.burst_power()
        self._lead = modem.preamble_samples + modem.margin + len(self._tail) + _MARGIN
        self._at = 0
        self._coming: list[tuple[int, int, _Burst]] = []
        self.bursts: list[_Burst] = []
        """What is on the air or has been since the last packets."""
        self.deaf: deque[tuple[int, int]] = deque()

    def add(self, burst: _Burst) -> None:
        """A burst will reach this receiver."""
        heapq.heappush(self._coming, (burst.start, len(self._coming), burst))

    def hear(self, until: int) -> list[Heard]:
        """The packets that are complete at a sample."""
        self.bursts = [burst for burst in self.bursts if burst.end > self._at]
        while self._coming and self._coming[0][0] < until:
            self.bursts.append(heapq.heappop(self._coming)[2])
        first = min((burst.start for burst in self.bursts), default=until)
        begin = max(self._at, min(first, until) - self._lead)
        if until <= begin:
            return []
        self._at = until
        samples = np.zeros(until - begin, np.complex64)
        sigma = 0.0
        for burst in self.bursts:
            low, high = max(begin, burst.start), min(until, burst.end)
            if low < high:
                samples[low - begin : high - begin] += burst.samples[low - burst.start : high - burst.start]
            sigma = max(sigma, self._sigma(burst.path.channel))
        for low, high in self.deaf:
            samples[max(low - begin, 0) : max(high - begin, 0)] = 0
        if sigma:
            drawn = self._noise.standard_normal((2, len(samples)), np.float32) * np.float32(sigma / math.sqrt(2))
            samples.real += drawn[0]
            samples.imag += drawn[1]
        while self.deaf and self.deaf[0][1] <= until:
            self.deaf.popleft()
        return self._receiver.feed(self._filtered(samples))

    def _sigma(self, channel: ChannelConfig) -> float:
        """Standard deviation of the noise: that of a burst at 0 dB, see :class:`SampleMedium`."""
        return 0.0 if channel.snr_db is None else math.sqrt(self._power)

    def _filtered(self, samples: Samples) -> Samples:
        if self._taps is None:
            return samples
        whole = np.concatenate((self._tail, samples))
        self._tail = whole[len(whole) - len(self._tail) :]
        return np.convolve(whole, self._taps, "valid").astype(np.complex64)


class SampleMedium(Medium):
    """See the module. A burst's amplitude is that of its SNR, over noise of the power that a burst is sent with.

    :param phys: of every robot, each with a modem of its own
    :param seed: of noise and phases
    """

    def __init__(self, paths: PathsAt, phys: Sequence[Phy], *, shared: bool = False, seed: int = 0) -> None:
        super().__init__(paths, shared=shared)
        self._phys = phys
        self._seed = seed
        self._ears: dict[tuple[int, int], _Ear] = {}
        self._phases = np.random.default_rng([seed, 3])

    def send(self, sender: int, data: bytes, start: float, airtime: float, rung: int = 0) -> Transmission:
        sent = super().send(sender, data, start, airtime, rung)
        phy = self._phys[sender]
        modem = phy.burst_modem
        assert modem is not None
        burst = modem.rungs[rung].modulate(data)
        first = round(start * phy.sample_rate)
        for path in self.paths_of(sent):
            phy.check_channel(path.channel)
            samples = self._through(burst, path.channel, start, phy.sample_rate)
            self._ear(path.receiver, sender).add(_Burst(sent, path, first, samples))
        if self.shared:
            last = round(sent.end * phy.sample_rate)
            self._ear(sender, sender).deaf.append((first, last))
        return sent

    def outcome(self, sent: Transmission) -> Iterator[tuple[Path, Reception]]:
        phy = self._phys[sent.sender]
        until = round(sent.end * phy.sample_rate)
        for path in self.paths_of(sent):
            ear = self._ear(path.receiver, sent.sender)
            arrived = False
            for heard in ear.hear(until):
                burst = next((one for one in ear.bursts if one.packet.data == heard.data), None)
                packet, way = (sent, path) if burst is None else (burst.packet, burst.path)
                arrived = arrived or packet is sent
                snr_db = math.inf if way.channel.snr_db is None else way.channel.snr_db
                yield way, Reception(path.receiver, packet, sent.end, heard.data, snr_db, snr_db, heard.snr_db)
            if not arrived:
                disturbing = {other.sender for other in self.others(sent) if self.reaches(other, path.receiver)}
                reason = "sending" if path.receiver in disturbing else "collision" if disturbing else "phy"
                self.lost[sent.sender, path.receiver][reason] += 1

    def _ear(self, receiver: int, sender: int) -> _Ear:
        """A robot's receiver: the one of the shared channel, or of the channel on which the sender sends."""
        key = receiver, -1 if self.shared else sender
        ear = self._ears.get(key)
        if ear is None:
            phy = self._phys[receiver]
            modem = phy.burst_modem
            assert modem is not None
            noise = np.random.default_rng([self._seed, 2, receiver, key[1] + 1])
            ear = self._ears[key] = _Ear(phy, modem, noise)
        return ear

    def _through(self, burst: Samples, channel: ChannelConfig, start: float, rate: float) -> Samples:
        """A burst after its path, without noise."""
        samples = burst.astype(np.complex128)
        if channel.doppler_hz:
            samples = _faded(samples, channel, start, rate)
        elif channel.taps != (1,):
            samples = np.convolve(samples, channel.taps)
        if channel.epsilon != 1:
            samples = _resampled(samples, channel.epsilon)
        gain = sum(abs(tap) ** 2 for tap in channel.taps)
        amplitude = 1.0 if channel.snr_db is None else math.sqrt(10 ** (channel.snr_db / 10) / gain)
        angle = self._phases.uniform(0, 2 * math.pi) + 2 * math.pi * channel.frequency_offset * np.arange(len(samples))
        return np.asarray(samples * (amplitude * np.exp(1j * angle)), np.complex64)


def _faded(samples: Wide, channel: ChannelConfig, start: float, rate: float) -> Wide:
    """The sum over the taps of a channel, each of which fades by itself."""
    out = np.zeros(len(samples) + len(channel.taps) - 1, np.complex128)
    times = start + np.arange(len(samples)) / rate
    steps = max(2, math.ceil(len(samples) / rate * channel.doppler_hz * _FADING_STEPS))
    coarse = np.linspace(times[0], times[-1], steps)
    for delay, tap in enumerate(channel.taps):
        if tap:
            seed = channel.seed if not delay else channel.seed * 1009 + delay
            gain = RayleighFading(channel.doppler_hz, seed).gain(coarse)
            faded = np.interp(times, coarse, gain.real) + 1j * np.interp(times, coarse, gain.imag)
            out[delay : delay + len(samples)] += tap * samples * faded
    return out


def _resampled(samples: Wide, ratio: float) -> Wide:
    """Samples taken ``ratio`` samples apart, by a windowed sinc."""
    places = np.arange(0, len(samples) - 1, ratio)
    whole = np.floor(places).astype(int)
    offsets = np.arange(1 - _SINC_HALF, _SINC_HALF + 1)
    distance = offsets - (places - whole)[:, None]
    weights = np.sinc(distance) * np.cos(np.pi * distance / (2 * _SINC_HALF + 2)) ** 2
    padded = np.pad(samples, _SINC_HALF)
    return np.asarray((padded[whole[:, None] + offsets + _SINC_HALF] * weights).sum(1))
