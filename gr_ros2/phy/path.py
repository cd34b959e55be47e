"""A packet's way through gate, transmitter, air, receiver and losses: what a simulated link and a radio have in common.

Invariants: what is received is impaired and looked at only here; a part that was not built in costs nothing, and what
it would do cannot be set; packets are counted at every place they pass.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from gr_ros2.config import ChannelConfig, replaced
from gr_ros2.errors import PhyError
from gr_ros2.phy.airtime import AirtimeGate
from gr_ros2.phy.base import PacketReceiver, PacketTransmitter, Phy, SymbolSource
from gr_ros2.phy.channel import Channel, PacketLoss
from gr_ros2.phy.tap import Samples, Tap

_LOOK = 1024
"""Samples of one look at the received signal."""


@dataclass(frozen=True)
class LinkCounts:
    """Packets at each place of the link, since the start.

    :param passed: let through by the gate
    :param backlog: in the gate, waiting for the air or on it
    :param transmitted: left the transmitter as samples
    :param received: came out of the receiver, where they are counted
    :param losses: dropped on purpose after the receiver, by the channel's setting that did it
    """

    passed: int
    backlog: int
    transmitted: int
    received: int
    losses: Mapping[str, int]

    @property
    def dropped(self) -> int:
        """Packets dropped on purpose, whatever the setting."""
        return sum(self.losses.values())


class PacketPath:
    """Stands before GNU Radio's class of a flowgraph or hier block, which makes ``phy`` and ``channel`` first."""

    phy: Phy
    channel: ChannelConfig
    """Impairments as they are set now."""
    _gate: AirtimeGate | None = None
    _transmitter: PacketTransmitter | None = None
    _faded: Channel | None = None
    _receiver: PacketReceiver | None = None
    _loss: PacketLoss | None = None
    _tap: Tap | None = None
    _symbols: SymbolSource | None = None

    def counts(self) -> LinkCounts:
        """A snapshot."""
        received = self._handled() if self._loss is None else self._loss.received
        passed = self._offered() if self._gate is None else self._gate.passed
        return LinkCounts(
            passed=passed,
            backlog=0 if self._gate is None else self._gate.backlog,
            transmitted=passed if self._transmitter is None else self._transmitter.packets_sent(),
            received=received,
            losses={} if self._loss is None else self._loss.dropped,
        )

    def samples(self) -> Samples | None:
        """Newest samples at the receiver's antenna, after the channel; None where there is no tap or nothing came."""
        return None if self._tap is None else self._tap.samples()

    def symbols(self) -> Samples | None:
        """Newest equalised payload symbols; None where there is no tap, or the PHY shows none."""
        return None if self._symbols is None else self._symbols.samples()

    @property
    def snr_db(self) -> float | None:
        """SNR of the newest packets received, dB over the sampled band; None before the first, or where the PHY does
        not tell."""
        return None if self._receiver is None else self._receiver.snr_db

    def set_snr_db(self, snr_db: float | None) -> None:
        """Noise on what is received, dB, None = none; see :meth:`Channel.set_snr_db`.

        :raises ConfigError: out of range
        :raises PhyError: where no simulated channel was built in
        """
        self._change("snr_db", snr_db, self._faded)

    def set_frequency_offset(self, frequency_offset: float) -> None:
        """Carrier frequency offset of what is received, fraction of the sample rate.

        :raises ConfigError: out of range
        :raises PhyError: where no simulated channel was built in
        """
        self._change("frequency_offset", frequency_offset, self._faded)

    def set_packet_loss(self, probability: float) -> None:
        """Probability that a packet received is dropped.

        :raises ConfigError: out of range
        :raises PhyError: where nothing that loses packets was built in
        """
        self._change("packet_loss", probability, self._loss)

    def _change(self, setting: str, value: float | None, part: Any) -> None:
        if part is None:
            raise PhyError(
                f"{setting}: {self._medium} was started without a simulated channel that could change it; set "
                f"channel.{setting} before the start, where that can be had"
            )
        channel = replaced(self.channel, **{setting: value})
        getattr(part, f"set_{setting}")(value)
        self.channel = channel

    @property
    def _medium(self) -> str:
        """What packets cross, for errors."""
        return f"phy {self.phy.name}"

    def _offered(self) -> int:
        """Packets that came to the path, where there is no gate to count them."""
        return 0

    def _handled(self) -> int:
        """Packets the end of the path is done with, where it tells."""
        return 0

    def _transmit(self, packets: Any) -> Any:
        """Connect a transmitter behind a block that gives packets."""
        self._transmitter = self.phy.transmitter()
        return self._follow(packets, self._transmitter)

    def _receive(self, samples: Any, *, faded: bool, shown: bool, own_process: bool = True) -> Any:
        """Connect channel, receiver and taps behind a block that gives samples; returns what the receiver hears."""
        graph: Any = self
        if faded:
            self._faded = Channel(self.channel, self.phy)
            graph.connect(samples, self._faded)
            samples = self._faded
        self._receiver = self.phy.receiver(own_process)
        graph.connect(samples, self._receiver)
        if shown:
            self._tap = Tap(_LOOK)
            graph.connect(samples, self._tap)
            self._symbols = self._receiver.tap_symbols()
        return samples

    def _follow(self, packets: Any, block: Any) -> Any:
        """Connect a block's port `pdus` behind another's; returns the block."""
        graph: Any = self
        graph.msg_connect(packets, "pdus", block, "pdus")
        return block
