"""The medium at samples: every receiver gets the sum of the bursts that reach it, and noise.

Each burst reaches a receiver with the gain, the phase, the echoes, the fading, the carrier offset and the clock of its
path. The burst modems of this package need no flowgraph; receivers elsewhere may be of any PHY with samples.

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
from itertools import count

import numpy as np
from numpy.typing import NDArray

from gr_ros2.link.events import AirPacket
from gr_ros2.phy import Phy
from gr_ros2.phy.burst import DemodulatedPacket
from gr_ros2.settings.config import ChannelConfig
from gr_ros2_lab.medium.base import Medium, Reception, Surroundings, Transmission
from gr_ros2_lab.medium.fading import RayleighFading

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
    :param snr_db: its level, dB; infinite without noise
    :param amplitude: by how much it is larger than it was sent
    """

    def __init__(
        self, packet: Transmission, snr_db: float, start: int, samples: Samples, amplitude: float = 1.0
    ) -> None:
        self.packet, self.snr_db, self.start, self.samples = packet, snr_db, start, samples
        self.amplitude = amplitude
        self.end = start + len(samples)


class _Ear:
    """One robot's receiver and what is on the air around it."""

    def __init__(self, phy: Phy, noise: np.random.Generator) -> None:
        self._phy, self._modem = phy, phy.burst_modem
        self._receiver = None if self._modem is None else self._modem.receiver()
        self._noise = noise
        self._taps = None if phy.receiver_taps is None else np.asarray(phy.receiver_taps, np.float32)
        self._tail = np.zeros(0 if self._taps is None else len(self._taps) - 1, np.complex64)
        self._power = phy.burst_power()
        self._lead = _MARGIN + len(self._tail)
        if self._modem is not None:
            self._lead += self._modem.preamble_samples + self._modem.margin
        self._at = self._fed = 0
        self._coming: list[tuple[int, int, _Burst]] = []
        self._order = count()
        self.bursts: list[_Burst] = []
        """What is on the air or has been since the last packets."""
        self.deaf: deque[tuple[int, int]] = deque()

    def add(self, burst: _Burst) -> None:
        """A burst will reach this receiver."""
        heapq.heappush(self._coming, (burst.start, next(self._order), burst))

    def hear(self, until: int) -> list[tuple[DemodulatedPacket, _Burst | None]]:
        """The packets that are complete at a sample, and the burst of each."""
        assert self._receiver is not None
        begin, samples = self.received(until)
        skipped = begin - self._fed
        self._fed += len(samples)
        return [(packet, self._burst_of(packet, skipped)) for packet in self._receiver.feed(self._filtered(samples))]

    def _burst_of(self, packet: DemodulatedPacket, skipped: int) -> _Burst | None:
        """The burst that began where a packet did, whatever its bytes: others may send the same. Of those that began
        together it is the strongest.

        :param skipped: samples of silence that the receiver did not get
        """
        if len(self.bursts) < 2:
            return self.bursts[0] if self.bursts else None
        assert self._modem is not None
        length = self._modem.rates[packet.mcs].samples_of(len(packet.data))
        first = packet.end + skipped - self._phy.lag - length
        return min(self.bursts, key=lambda burst: (abs(burst.start - first), -burst.snr_db))

    def silent(self, until: int) -> bool:
        """Whether no burst reaches this receiver between the last sample that it got and this one."""
        coming = bool(self._coming) and self._coming[0][0] < until
        return not coming and all(burst.end <= self._at for burst in self.bursts)

    def over(self, until: int) -> int:
        """Where the last of those bursts ends that are over at a sample; the last sample that it got where none is."""
        ends = [burst.end for burst in self.bursts] + [burst.end for _, _, burst in self._coming]
        return max((end for end in ends if end <= until), default=self._at)

    def received(self, until: int) -> tuple[int, Samples]:
        """The samples that reach the receiver, up to one: the first of them, and its number. Where no burst does, there
        are none but for a stretch of noise before the next."""
        self.bursts = [burst for burst in self.bursts if burst.end > self._at]
        while self._coming and self._coming[0][0] < until:
            self.bursts.append(heapq.heappop(self._coming)[2])
        first = min((burst.start for burst in self.bursts), default=until)
        begin = max(self._at, min(first, until) - self._lead)
        if until <= begin:
            return until, np.zeros(0, np.complex64)
        self._at = until
        samples = np.zeros(until - begin, np.complex64)
        sigma = 0.0
        for burst in self.bursts:
            low, high = max(begin, burst.start), min(until, burst.end)
            if low < high:
                samples[low - begin : high - begin] += burst.samples[low - burst.start : high - burst.start]
            if burst.snr_db < math.inf:
                sigma = math.sqrt(self._power)  # a burst at 0 dB, see :class:`SampleMedium`
        for low, high in self.deaf:
            samples[max(low - begin, 0) : max(high - begin, 0)] = 0
        if sigma:
            drawn = self._noise.standard_normal((2, len(samples)), np.float32) * np.float32(sigma / math.sqrt(2))
            samples.real += drawn[0]
            samples.imag += drawn[1]
        self.forget(until)
        return begin, samples

    def forget(self, until: int) -> None:
        """Forget what the robot has sent up to a sample."""
        while self.deaf and self.deaf[0][1] <= until:
            self.deaf.popleft()

    def _filtered(self, samples: Samples) -> Samples:
        if self._taps is None:
            return samples
        whole = np.concatenate((self._tail, samples))
        self._tail = whole[len(whole) - len(self._tail) :]
        return np.convolve(whole, self._taps, "valid").astype(np.complex64)


class SampleMedium(Medium):
    """Adds the bursts at each receiver. A burst's amplitude is that of its SNR, over noise of the
    power that a burst is sent with.

    :param phys: of every robot, each with a modem of its own
    :param seed: of noise and phases
    """

    def __init__(self, around: Surroundings, phys: Sequence[Phy], *, shared: bool = False, seed: int = 0) -> None:
        super().__init__(around, shared=shared)
        self._phys = phys
        self._seed = seed
        self._ears: dict[tuple[int, int], _Ear] = {}
        self._phases = np.random.default_rng([seed, 3])

    def send(self, sender: int, data: bytes, start: float, airtime: float, mcs: int = 0) -> Transmission:
        sent = super().send(sender, data, start, airtime, mcs)
        phy = self._phys[sender]
        modem = phy.burst_modem
        assert modem is not None
        self.transmit(sent, modem.rates[mcs].modulate(data), elsewhere=False)
        return sent

    def transmit(self, sent: Transmission, burst: Samples, *, elsewhere: bool = True) -> None:
        """A burst starts, and reaches all who hear its sender.

        :param elsewhere: whether the receivers are: a packet that its path drops is no burst then, one that it delays a
            later one
        """
        sender, start, phy = sent.sender, sent.start, self._phys[sent.sender]
        first = round(start * phy.sample_rate)
        heard = self.hearers(sent)
        rows = (heard.ids.tolist(), heard.snr_db.tolist(), heard.shift_hz.tolist())
        for receiver, snr_db, shift_hz in zip(*rows, strict=True):
            delay_s = 0.0
            if elsewhere:
                crossing = self.way((sender, receiver)).delay_s(sent.end - self._begin_s, len(sent.data))
                if crossing is None:
                    continue
                delay_s = crossing
            channel = self.around.path(sender, receiver).channel
            phy.check_channel(channel)
            amplitude = _amplitude(channel, snr_db)
            samples = self._heard(_through(burst, channel, start, phy.sample_rate), channel, amplitude, shift_hz)
            begin = first + round(delay_s * phy.sample_rate)
            self._ear(receiver, sender).add(_Burst(sent, snr_db, begin, samples, amplitude))
        if self.shared:
            self._ear(sender, sender).deaf.append((first, first + len(burst)))

    def received(self, receiver: int, until: float) -> list[tuple[float, Samples]]:
        """The samples that reach a robot up to a time in s, in pieces, each with the time of its first; none while
        nothing is on the air around it. For receivers elsewhere.

        A robot there has one receiver. So bursts on channels of their own come one after the other, each whole once it
        is over, and as strong as they were sent.
        """
        rate = self._phys[receiver].sample_rate
        last = round(until * rate)
        if self.shared:
            ear = self._ear(receiver, receiver)
            if ear.silent(last):
                ear.forget(last)
                return []
            first, samples = ear.received(last)
            return [(first / rate, samples)]
        found = []
        for ear in [ear for (hearer, _), ear in self._ears.items() if hearer == receiver]:
            first, samples = ear.received(ear.over(last))
            if len(samples):
                found.append((first / rate, samples / np.float32(ear.bursts[-1].amplitude)))
        return sorted(found, key=lambda piece: piece[0])

    def outcome(self, sent: Transmission) -> Iterator[Reception]:
        phy = self._phys[sent.sender]
        until = round(sent.end * phy.sample_rate)
        for receiver in self.hearers(sent).ids.tolist():
            ear = self._ear(receiver, sent.sender)
            arrived = False
            for heard, burst in ear.hear(until):
                packet, snr_db = (sent, math.inf) if burst is None else (burst.packet, burst.snr_db)
                arrived = arrived or packet is sent
                arrival = AirPacket(heard.data, packet.start, snr_db=heard.snr_db)
                yield Reception(receiver, packet, sent.end, arrival, snr_db, snr_db)
            if not arrived:
                self.lost.add(self._reason(sent, receiver), sent.sender, receiver)

    def _reason(self, sent: Transmission, receiver: int) -> str:
        """Why a packet did not arrive."""
        others = self.others(sent)
        if any(other.sender == receiver for other in others):
            return "sending"
        return "collision" if any(self.hearers(other).at[receiver] for other in others) else "phy"

    def _ear(self, receiver: int, sender: int) -> _Ear:
        """A robot's receiver: the one of the shared channel, or of the channel on which the sender sends."""
        key = receiver, -1 if self.shared else sender
        ear = self._ears.get(key)
        if ear is None:
            noise = np.random.default_rng([self._seed, 2, receiver, key[1] + 1])
            ear = self._ears[key] = _Ear(self._phys[receiver], noise)
        return ear

    def _heard(self, samples: Wide, channel: ChannelConfig, amplitude: float, shift_hz: float) -> Samples:
        """A burst with the level, the carrier and the phase with which it reaches a receiver."""
        offset = channel.frequency_offset + shift_hz / self._phys[0].sample_rate
        angle = self._phases.uniform(0, 2 * math.pi) + 2 * math.pi * offset * np.arange(len(samples))
        return np.asarray(samples * (amplitude * np.exp(1j * angle)), np.complex64)


def _amplitude(channel: ChannelConfig, snr_db: float) -> float:
    """Of a burst that reaches a receiver at a level, before its echoes are added."""
    gain = sum(abs(tap) ** 2 for tap in channel.taps)
    return 1.0 if snr_db == math.inf else math.sqrt(10 ** (snr_db / 10) / gain)


def _through(burst: Samples, channel: ChannelConfig, start: float, rate: float) -> Wide:
    """A burst after echoes, fading and with the clock of its path."""
    samples = burst.astype(np.complex128)
    if channel.doppler_hz:
        samples = _faded(samples, channel, start, rate)
    elif channel.taps != (1,):
        samples = np.convolve(samples, channel.taps)
    return samples if channel.epsilon == 1 else _resampled(samples, channel.epsilon)


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
