"""The simulated channel: GNU Radio's channel model on the samples, random loss on the packets.

Laws: noise is set from the mean power of a burst as it arrives, so `snr_db` means the same for every PHY; tags stop
here (a transmitter's length tag would otherwise overrule the header the receiver parses); equal seeds give equal
losses; every packet lost here is counted.
"""

from __future__ import annotations

import random
from collections.abc import Sequence
from dataclasses import fields
from typing import Any

import pmt
from gnuradio import channels, gr

from gr_ros2.config import ChannelConfig, build
from gr_ros2.phy.base import Phy
from gr_ros2.phy.threads import BlockThread

_PDUS = pmt.intern("pdus")


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
    """Complex stream in, complex stream out: taps, clock and carrier offset, noise."""

    def __init__(self, config: ChannelConfig, phy: Phy) -> None:
        super().__init__(
            "gr_ros2_channel", gr.io_signature(1, 1, gr.sizeof_gr_complex), gr.io_signature(1, 1, gr.sizeof_gr_complex)
        )
        self.config = config
        self._burst_power = phy.burst_power()
        # GNU Radio takes a noise seed of 0 as "seed from the time of day".
        self._model = channels.channel_model(
            self._voltage(), config.frequency_offset, config.epsilon, list(config.taps), config.seed + 1, True
        )
        self.connect(self, self._model, self)

    def set_snr_db(self, snr_db: float | None) -> None:
        """dB, None = no noise; heard about 8192 samples later, since the noise source has filled its buffer by then.

        :raises ConfigError: out of range
        """
        self.config = _changed(self.config, snr_db=snr_db)
        self._model.set_noise_voltage(self._voltage())

    def set_frequency_offset(self, frequency_offset: float) -> None:
        """Carrier frequency offset, fraction of the sample rate.

        :raises ConfigError: out of range
        """
        self.config = _changed(self.config, frequency_offset=frequency_offset)
        self._model.set_frequency_offset(self.config.frequency_offset)

    def _voltage(self) -> float:
        return noise_voltage(self.config.snr_db, self._burst_power, self.config.taps)


class PacketLoss(gr.basic_block):  # type: ignore[misc]
    """Message port `pdus` in and out: each packet is dropped with a probability, and counted either way.

    :param probability: 0..1
    :param seed: same seed, same losses for the same order of packets
    :raises ConfigError: for a probability out of range
    """

    def __init__(self, probability: float = 0.0, seed: int = 0) -> None:
        super().__init__("gr_ros2_packet_loss", None, None)
        self._random = random.Random(seed)
        self._probability = 0.0
        self.set_probability(probability)
        self.received = 0
        self.dropped = 0
        self._block_thread = BlockThread()
        self.message_port_register_in(_PDUS)
        self.message_port_register_out(_PDUS)
        self.set_msg_handler(_PDUS, self._pass)

    def set_probability(self, probability: float) -> None:
        """Change the loss while running.

        :raises ConfigError: out of range
        """
        self._probability = build(ChannelConfig, {"packet_loss": probability}).packet_loss

    def start(self) -> bool:
        self._block_thread.keep()
        return True

    def stop(self) -> bool:
        self._block_thread.release()
        return True

    def _pass(self, pdu: Any) -> None:
        self.received += 1
        # Drawn always, so that changing the probability does not shift what the seed does later.
        if self._random.random() < self._probability:
            self.dropped += 1
        else:
            self.message_port_pub(_PDUS, pdu)


def _changed(config: ChannelConfig, **settings: Any) -> ChannelConfig:
    return build(ChannelConfig, {**{item.name: getattr(config, item.name) for item in fields(config)}, **settings})
