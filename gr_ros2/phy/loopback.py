"""One simulated link in one flowgraph: source, gate, transmitter, channel, receiver, losses, sink.

Laws: any PHY of the table goes in; one without samples skips transmitter, channel and receiver; after ``stop`` no
thread of the link runs, whatever state it was in.
"""

from __future__ import annotations

import weakref
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from types import TracebackType
from typing import Any

from gnuradio import gr

from gr_ros2.config import ChannelConfig, replaced
from gr_ros2.errors import PhyError
from gr_ros2.phy.airtime import AirtimeGate, Pace
from gr_ros2.phy.base import Phy
from gr_ros2.phy.channel import Channel, PacketLoss
from gr_ros2.phy.tap import Samples, Tap
from gr_ros2.phy.threads import begin

TAP_SIZE = 1024
"""Samples of one look at the received signal."""


@dataclass(frozen=True)
class LinkCounts:
    """Packets at each place of the link, since the start.

    :param passed: let through by the gate
    :param backlog: in the gate, waiting for the air or on it
    :param transmitted: left the transmitter as samples
    :param received: came out of the receiver
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


class LoopbackLink(gr.top_block):  # type: ignore[misc]
    """A flowgraph from a source's message port `pdus` to a sink's.

    :param phy: which physical layer
    :param source: block with message port `pdus` out, and `credit` in where ``paced``
    :param sink: block with message port `pdus` in, which counts the PDUs it is done with in ``handled``
    :param channel: between transmitter and receiver
    :param pace: `airtime` as on the air, `flow` as fast as the flowgraph takes it (see :class:`AirtimeGate`)
    :param paced: the gate's credits pace the source; False offers every packet at once, as the paper does. With a PHY
        without samples there is nothing to pace by, except with pace `flow`
    :param instrumented: build in what a person at a dashboard uses: packet loss that can be set on any PHY, and taps
        for spectrum and constellation
    :raises ConfigError: for a channel that this PHY cannot have
    """

    def __init__(
        self,
        phy: Phy,
        source: Any,
        sink: Any,
        *,
        channel: ChannelConfig | None = None,
        pace: Pace = "airtime",
        paced: bool = True,
        instrumented: bool = False,
    ) -> None:
        super().__init__("gr_ros2_loopback", catch_exceptions=True)
        channel = channel if channel is not None else ChannelConfig()
        phy.check_channel(channel)
        self.phy = phy
        self.source = source
        self.sink = sink
        self._running = False
        self._pace = pace
        self._transmitter = phy.transmitter() if phy.has_samples else None
        self._channel = Channel(channel, phy) if phy.has_samples else None
        # Each Python block costs a packet as much as source or sink do, so none stands here that does nothing.
        self._gate = (
            AirtimeGate(phy.airtime(), pace, progress=self._progress) if phy.has_samples or pace == "flow" else None
        )
        lossy = phy.has_samples or channel.loses_packets or instrumented
        self._loss = PacketLoss(channel) if lossy else None
        self._config = channel
        self._tap: Tap | None = None
        self._symbols: Tap | None = None
        last = source
        if self._gate is not None:
            last = self._follow(last, self._gate)
        if self._transmitter is not None:
            receiver = phy.receiver()
            self.msg_connect(last, "pdus", self._transmitter, "pdus")
            self.connect(self._transmitter, self._channel, receiver)
            if instrumented:
                self._tap = Tap(TAP_SIZE)
                self.connect(self._channel, self._tap)
                self._symbols = receiver.tap_symbols() if hasattr(receiver, "tap_symbols") else None
            last = receiver
            # A hier block with message ports holds itself, and 60 of the system's 4096 shared memory segments for OFDM.
            for hier_block in (self._transmitter, receiver):
                weakref.finalize(self, hier_block.disconnect_all)
        if self._loss is not None:
            last = self._follow(last, self._loss)
        self.msg_connect(last, "pdus", sink, "pdus")
        if paced and self._gate is not None:
            source.use_credit()
            self.msg_connect(self._gate, "credit", source, "credit")

    def start(self, max_noutput_items: int = 10_000_000) -> None:
        """Start every block's thread.

        :raises PhyError: when GNU Radio refuses the flowgraph
        """
        self._running = True
        try:
            begin(partial(super().start, max_noutput_items))
        except (RuntimeError, MemoryError) as error:
            self.stop()
            raise PhyError(f"phy {self.phy.name}: the flowgraph does not start ({error})") from error
        if self._pace == "airtime":
            self.phy.prefer_latency()

    def stop(self) -> None:
        """Stop and wait for every thread; harmless when it is not running."""
        if self._running:
            self._running = False
            super().stop()
            self.wait()

    def run_began(self, now: float) -> None:
        """Let the channel's outages count from now, s, monotonic, and not from the start of the flowgraph."""
        if self._loss is not None:
            self._loss.epoch = now

    def counts(self) -> LinkCounts:
        """A snapshot."""
        received = int(self.sink.handled) if self._loss is None else self._loss.received
        passed = received if self._gate is None else self._gate.passed
        return LinkCounts(
            passed=passed,
            backlog=0 if self._gate is None else self._gate.backlog,
            transmitted=passed if self._transmitter is None else self._transmitter.packets_sent(),
            received=received,
            losses=self._losses(),
        )

    @property
    def channel(self) -> ChannelConfig:
        """The channel as it is set now."""
        return self._config

    def samples(self) -> Samples | None:
        """Newest samples at the receiver's antenna, after the channel; None where there is no tap or nothing came."""
        return None if self._tap is None else self._tap.samples()

    def symbols(self) -> Samples | None:
        """Newest equalised payload symbols, of an instrumented link whose PHY shows them; otherwise None."""
        return None if self._symbols is None else self._symbols.samples()

    def set_snr_db(self, snr_db: float | None) -> None:
        """See :meth:`Channel.set_snr_db`.

        :raises PhyError: for a PHY without samples
        """
        channel = self._sampled("snr_db")
        channel.set_snr_db(snr_db)
        self._config = replace(self._config, snr_db=channel.config.snr_db)

    def set_frequency_offset(self, frequency_offset: float) -> None:
        """See :meth:`Channel.set_frequency_offset`.

        :raises PhyError: for a PHY without samples
        """
        channel = self._sampled("frequency_offset")
        channel.set_frequency_offset(frequency_offset)
        self._config = replace(self._config, frequency_offset=channel.config.frequency_offset)

    def set_packet_loss(self, probability: float) -> None:
        """Probability that a packet is dropped between PHY and sink.

        :raises ConfigError: out of range
        :raises PhyError: on a PHY without samples that was started without loss
        """
        if self._loss is None:
            raise PhyError(f"packet_loss: phy {self.phy.name} was started without; start with packet_loss above 0")
        self._config = replaced(self._config, packet_loss=probability)
        self._loss.set_packet_loss(probability)

    def __enter__(self) -> LoopbackLink:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    def _sampled(self, setting: str) -> Channel:
        if self._channel is None:
            raise PhyError(f"{setting}: phy {self.phy.name} has no samples to change")
        return self._channel

    def _progress(self) -> int:
        """Packets that are through, as far as a window has to know."""
        if self._transmitter is None:
            return int(self.sink.handled) + sum(self._losses().values())
        return int(self._transmitter.packets_sent())

    def _losses(self) -> Mapping[str, int]:
        return {} if self._loss is None else self._loss.dropped

    def _follow(self, last: Any, block: Any) -> Any:
        self.msg_connect(last, "pdus", block, "pdus")
        return block
