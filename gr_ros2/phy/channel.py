"""The simulated channel as GNU Radio blocks: fading, taps, offsets and noise on the samples, losses on the packets.

Invariants: noise is set from the mean power of a burst as it arrives, so `snr_db` means the same for every PHY; tags
are removed here (a transmitter's length tag would otherwise override the header that the receiver parses); equal seeds
give equal noise, fading and losses; every packet lost here is counted. Fading advances with the samples, which flow
only while something is on the air.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Sequence, Set
from typing import Any, ClassVar

import numpy as np
from gnuradio import gr

from gr_ros2.link.events import AirPacket
from gr_ros2.link.losses import PduLosses
from gr_ros2.phy.base import Phy, Samples
from gr_ros2.phy.pdus import PduPort, packets_of, take_messages
from gr_ros2.phy.threads import ThreadState
from gr_ros2.settings.config import ChannelConfig, replaced

_SINUSOIDS = 16
"""Number of sinusoids that are added to one fading tap; GNU Radio's manual recommends 8 or more."""
_FADING_SEEDS = 1009
"""Distance between the seeds of two channels, so that neighbouring seeds share no tap: GNU Radio seeds the taps with
seed, seed + 1, ..."""
_LARGEST_SEED = 2**31 - 1


def noise_voltage(snr_db: float | None, burst_power: float, taps: Sequence[complex] = (1.0,)) -> float:
    """Standard deviation of complex noise for an SNR over the sampled band.

    :param snr_db: dB, None = no noise
    :param burst_power: mean squared magnitude of a transmitted burst
    :param taps: impulse response the burst goes through; its gain counts as signal
    """
    if snr_db is None:
        return 0.0
    received = burst_power * sum(abs(tap) ** 2 for tap in taps)
    return float((received / 10 ** (snr_db / 10)) ** 0.5)


class Channel(gr.hier_block2):  # type: ignore[misc]
    """Complex stream in, complex stream out: fading, taps, clock and carrier offset, noise.

    With fading every tap is multiplied by a Rayleigh process of its own with mean power 1, so that `snr_db` is the
    mean over the fades.
    """

    def __init__(self, config: ChannelConfig, phy: Phy) -> None:
        from gnuradio import channels  # here: 8 MB that a robot's link does not need

        super().__init__(
            "gr_ros2_channel", gr.io_signature(1, 1, gr.sizeof_gr_complex), gr.io_signature(1, 1, gr.sizeof_gr_complex)
        )
        self.config = config
        self._burst_power = phy.burst_power()
        faded = [_fading(config, phy.sample_rate)] if config.doppler_hz else []
        # GNU Radio takes a noise seed of 0 as "seed from the time of day".
        self._model = channels.channel_model(
            self._voltage(),
            config.frequency_offset,
            config.epsilon,
            [1.0] if faded else list(config.taps),
            config.seed + 1,
            True,
        )
        self.connect(self, *faded, self._model, self)

    def set_snr_db(self, snr_db: float | None) -> None:
        """Set the SNR in dB, None = no noise. It takes effect about 8192 samples later, because the noise source has
        filled its buffer in advance.

        :raises ConfigError: out of range
        """
        self.config = replaced(self.config, snr_db=snr_db)
        self._model.set_noise_voltage(self._voltage())

    def set_frequency_offset(self, frequency_offset: float) -> None:
        """Carrier frequency offset, fraction of the sample rate.

        :raises ConfigError: out of range
        """
        self.config = replaced(self.config, frequency_offset=frequency_offset)
        self._model.set_frequency_offset(self.config.frequency_offset)

    def _voltage(self) -> float:
        return noise_voltage(self.config.snr_db, self._burst_power, self.config.taps)


class BurstChannel:
    """Noise and a carrier offset on bursts as they come, without a stream: what may be changed while a link runs."""

    settings: ClassVar[Set[str]] = {"snr_db", "frequency_offset"}
    """Those that it can apply. Others need a :class:`Channel`."""

    def __init__(self, config: ChannelConfig, phy: Phy) -> None:
        self.config = config
        self._burst_power = phy.burst_power()
        self._rng = np.random.default_rng(config.seed)
        self._phase = 0.0
        """Of the next sample, in turns."""

    def set_snr_db(self, snr_db: float | None) -> None:
        """Set the SNR in dB, None = no noise.

        :raises ConfigError: out of range
        """
        self.config = replaced(self.config, snr_db=snr_db)

    def set_frequency_offset(self, frequency_offset: float) -> None:
        """Carrier frequency offset, fraction of the sample rate.

        :raises ConfigError: out of range
        """
        self.config = replaced(self.config, frequency_offset=frequency_offset)

    def __call__(self, samples: Samples) -> Samples:
        """The samples as they arrive."""
        config, count = self.config, len(samples)
        if offset := config.frequency_offset:
            turns = self._phase + offset * np.arange(count)
            self._phase = (self._phase + offset * count) % 1.0
            samples = (samples * np.exp(2j * np.pi * turns)).astype(np.complex64)
        if voltage := noise_voltage(config.snr_db, self._burst_power):
            noise = self._rng.standard_normal(2 * count, np.float32).view(np.complex64)
            samples = samples + noise * np.float32(voltage / 2**0.5)
        return samples


def _fading(config: ChannelConfig, sample_rate: float) -> Any:
    """A block in which every tap that is not zero fades independently."""
    from gnuradio import channels

    shift, seed = config.doppler_hz / sample_rate, config.seed * _FADING_SEEDS % _LARGEST_SEED
    delays = [float(delay) for delay, tap in enumerate(config.taps) if tap]
    mags = [abs(tap) for tap in config.taps if tap]
    return channels.selective_fading_model(_SINUSOIDS, shift, False, 0.0, seed, delays, mags, len(config.taps))


class PacketLoss(gr.basic_block):  # type: ignore[misc]
    """Message port `pdus` in and out: drops packets as the channel settings say, and counts all packets.

    :param config: the settings that drop packets, and their seed: an equal seed gives equal losses for the same order
        of packets
    """

    def __init__(self, config: ChannelConfig) -> None:
        super().__init__("gr_ros2_packet_loss", None, None)
        self._losses = PduLosses(config)
        self.epoch = time.monotonic()
        """s, monotonic: when the run began; outages count from here."""
        self.received = 0
        self._thread_state = ThreadState()
        self._port = self.passes_on_to = PduPort(self)
        take_messages(self, "pdus", "_arrive", called="take")

    @property
    def dropped(self) -> Counter[str]:
        """Packets lost so far, by the setting that lost them."""
        return Counter(self._losses.dropped)

    def set_packet_loss(self, probability: float) -> None:
        """Change the random loss while running; the caller checks its range."""
        self._losses.packet_loss = probability

    def start(self) -> bool:
        self.epoch = time.monotonic()
        self._port.find_readers()
        self._thread_state.keep()
        return True

    def stop(self) -> bool:
        self._thread_state.release()
        return True

    def take(self, packets: Sequence[AirPacket]) -> None:
        """Pass on those packets that are not lost."""
        self._port.send([packet for packet in packets if self._passes()])

    def _arrive(self, pdu: Any) -> None:
        if self._port.direct:
            self.take(packets_of(pdu)[0])
        elif self._passes():
            self._port.send_pdu(pdu)

    def _passes(self) -> bool:
        self.received += 1
        return self._losses.passes(time.monotonic() - self.epoch)
