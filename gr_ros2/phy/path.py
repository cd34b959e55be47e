"""The path of a packet through gate, transmitter, channel, receiver and losses: common to a simulated link and a radio.

Invariants: only this module impairs and taps received samples; a part that was not built in costs nothing, and its
settings cannot be changed; packets are counted at every place they pass.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from gr_ros2.core.errors import PhyError
from gr_ros2.link.lateness import Lateness
from gr_ros2.phy.airtime import AirtimeGate
from gr_ros2.phy.base import PacketReceiver, PacketTransmitter, Phy, SymbolSource
from gr_ros2.phy.channel import BurstChannel, Channel, PacketLoss
from gr_ros2.phy.tap import Samples, Tap
from gr_ros2.settings.config import ChannelConfig, replaced

SAMPLES_SHOWN = 1024
"""Samples of one snapshot of the received signal."""


@dataclass(frozen=True)
class LinkCounts:
    """Packets at each place of the link, since the start.

    :param passed: packets that the gate let through
    :param backlog: packets in the gate, waiting for the channel or occupying it
    :param transmitted: packets that left the transmitter as samples
    :param received: packets that came out of the receiver, if they are counted
    :param losses: packets dropped on purpose after the receiver, by the channel's setting that caused it
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
    """Mix-in for a flowgraph or hier block; list it before GNU Radio's class. The class sets ``phy`` and ``channel``
    first."""

    phy: Phy
    channel: ChannelConfig
    """The current impairments."""
    _gate: AirtimeGate | None = None
    _transmitter: PacketTransmitter | None = None
    _faded: Channel | BurstChannel | None = None
    _receiver: PacketReceiver | None = None
    _loss: PacketLoss | None = None
    _tap: SymbolSource | None = None
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

    def gate_lateness(self) -> Lateness | None:
        """Delays of the gate; None if there is no gate."""
        return None if self._gate is None else self._gate.lateness

    @property
    def changeable(self) -> bool:
        """Whether a channel was built in that can be changed while it runs."""
        return self._loss is not None

    def samples(self) -> Samples | None:
        """Newest samples at the receiver's antenna, after the channel; None without a tap, or if no samples arrived."""
        return None if self._tap is None else self._tap.samples()

    def symbols(self) -> Samples | None:
        """Newest equalised payload symbols; None if there is no tap, or the PHY shows none."""
        return None if self._symbols is None else self._symbols.samples()

    @property
    def snr_db(self) -> float | None:
        """SNR of the newest packets received, dB over the sampled band; None before the first, or if the PHY does not
        measure it."""
        return None if self._receiver is None else self._receiver.snr_db

    @property
    def transmits(self) -> bool:
        """Whether packets may pass the gate; True without one."""
        return self._gate is None or self._gate.transmits

    def transmit(self, *, on: bool) -> None:
        """Switch sending off, at once for all packets that have not reached the device, or on again.

        :raises PhyError: if there is no gate
        """
        if self._gate is None:
            raise PhyError(f"{self._medium}: packets pass at once, so sending cannot be switched off")
        self._gate.transmit(on=on)

    def set_snr_db(self, snr_db: float | None) -> None:
        """Set the SNR of the received signal, dB, None = no noise; see :meth:`Channel.set_snr_db`.

        :raises ConfigError: out of range
        :raises PhyError: if no simulated channel was built in
        """
        self._change("snr_db", snr_db, self._faded)

    def set_frequency_offset(self, frequency_offset: float) -> None:
        """Set the carrier frequency offset of the received signal, fraction of the sample rate.

        :raises ConfigError: out of range
        :raises PhyError: if no simulated channel was built in
        """
        self._change("frequency_offset", frequency_offset, self._faded)

    def set_packet_loss(self, probability: float) -> None:
        """Set the probability that a received packet is dropped.

        :raises ConfigError: out of range
        :raises PhyError: if nothing that loses packets was built in
        """
        self._change("packet_loss", probability, self._loss)

    def _change(self, setting: str, value: float | None, part: Any) -> None:
        if part is None:
            raise PhyError(
                f"{setting}: {self._medium} was started without a simulated channel that can change it; set "
                f"channel.{setting} before the start, where the PHY supports it"
            )
        channel = replaced(self.channel, **{setting: value})
        getattr(part, f"set_{setting}")(value)
        self.channel = channel

    @property
    def _medium(self) -> str:
        """Name of the medium, for errors."""
        return f"phy {self.phy.name}"

    @property
    def _flowgraph(self) -> Any:
        """Where the parts are connected."""
        return self

    def _offered(self) -> int:
        """Packets that entered the path, if there is no gate to count them."""
        return 0

    def _handled(self) -> int:
        """Packets that the end of the path has processed, if it counts them."""
        return 0

    def _transmit(self, packets: Any) -> Any:
        """Connect a transmitter to a block that gives packets."""
        self._transmitter = self.phy.transmitter()
        return self._follow(packets, self._transmitter)

    def _receive(self, samples: Any, *, faded: bool, shown: bool) -> Any:
        """Connect channel, receiver and taps to a block that gives samples; returns the block that gives the receiver's
        input."""
        graph = self._flowgraph
        if faded:
            self._faded = Channel(self.channel, self.phy)
            graph.connect(samples, self._faded)
            samples = self._faded
        self._receiver = self.phy.receiver()
        graph.connect(samples, self._receiver)
        if shown:
            self._tap = Tap(SAMPLES_SHOWN)
            graph.connect(samples, self._tap)
            self._symbols = self._receiver.tap_symbols()
        return samples

    def _follow(self, packets: Any, block: Any) -> Any:
        """Connect a block's port `pdus` to that of another block; returns the block."""
        self._flowgraph.msg_connect(packets, "pdus", block, "pdus")
        return block
