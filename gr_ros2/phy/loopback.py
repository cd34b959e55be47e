"""A simulated link in one direction as a flowgraph: source, gate, transmitter, channel, receiver, losses, sink.

Invariants: any PHY of the table works here; a PHY without samples skips transmitter, channel and receiver; a block that
would do nothing is left out, since each Python block costs as much time per packet as source or sink.
"""

from __future__ import annotations

import weakref
from typing import Any

from gr_ros2.phy.airtime import AirtimeGate
from gr_ros2.phy.base import Phy
from gr_ros2.phy.channel import PacketLoss
from gr_ros2.phy.flowgraph import Flowgraph
from gr_ros2.phy.path import PacketPath
from gr_ros2.phy.window import CreditWindow
from gr_ros2.settings.config import ChannelConfig


class LoopbackLink(PacketPath, Flowgraph):
    """A path from a source's message port `pdus` to that of a sink.

    :param phy: which physical layer
    :param source: block with message port `pdus` out, whose PDUs it counts in ``emitted``
    :param sink: block with message port `pdus` in, which counts the processed PDUs in ``handled``
    :param channel: between transmitter and receiver
    :param throttled: packets pass at the rate of the channel (:class:`AirtimeGate`); False lets them pass as fast as
        the flowgraph takes them (:class:`CreditWindow`)
    :param paced: credits are granted to the source; False for a source without port `credit`. A PHY without samples
        has no airtime, so it does not set a rate
    :param instrumented: build in what the dashboard uses: packet loss that can be set on any PHY, a channel that can be
        changed, and taps for spectrum and constellation
    :raises ConfigError: for a channel that this PHY does not support
    """

    def __init__(
        self,
        phy: Phy,
        source: Any,
        sink: Any,
        *,
        channel: ChannelConfig | None = None,
        throttled: bool = True,
        paced: bool = True,
        instrumented: bool = False,
    ) -> None:
        super().__init__("gr_ros2_loopback", f"phy {phy.name}")
        self.phy, self.source, self.sink = phy, source, sink
        self.channel = ChannelConfig() if channel is None else channel
        phy.check_channel(self.channel)
        last = source
        if throttled and phy.has_airtime:
            airtime_of = phy.airtime if phy.any_length else None
            self._gate = AirtimeGate(phy.airtime(), airtime_of=airtime_of)
            last = self._follow(last, self._gate)
        if phy.has_samples:
            sent = self._transmit(last)
            # The channel also stops tags.
            faded = instrumented or bool(self.channel.on_samples()) or phy.leaves_tags()
            self._receive(sent, faded=faded, shown=instrumented)
            last = self._receiver
        # A hier block with message ports keeps itself alive, and with it, for OFDM, 60 of the system's 4096 shared
        # memory segments.
        for hier_block in (self._transmitter, self._receiver):
            if hier_block is not None:
                weakref.finalize(self, hier_block.release)
        if self.channel.loses_packets or instrumented:
            self._loss = PacketLoss(self.channel)
            last = self._follow(last, self._loss)
        self._follow(last, sink)
        # Keep a reference, since GNU Radio holds none to a Python block.
        self._pacer = self._gate if throttled else CreditWindow(self._progress)
        if paced and self._pacer is not None:
            source.use_credit()
            self.msg_connect(self._pacer, "credit", source, "credit")

    def start(self, max_noutput_items: int = 10_000_000) -> None:
        super().start(max_noutput_items)
        if self._gate is not None:
            self.phy.prefer_latency()

    def _offered(self) -> int:
        return int(self.source.emitted)

    def _handled(self) -> int:
        return int(self.sink.handled)

    def _progress(self) -> int:
        """Packets that have passed the link, for the credit window."""
        if self._transmitter is None:
            return self._handled() + (0 if self._loss is None else self._loss.dropped.total())
        return int(self._transmitter.packets_sent())
