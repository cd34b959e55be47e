"""A simulated link in a flowgraph: source, gate, transmitter, channel, receiver, losses, delay, sink; and further
receivers, each with a channel and a sink of its own.

Invariants: any PHY of the table works here; a PHY without samples skips transmitter, channel and receiver; a block that
would do nothing is left out, since each Python block costs as much time per packet as source or sink.
"""

from __future__ import annotations

import time
import weakref
from collections.abc import Sequence
from typing import Any

from gr_ros2.link.airtime_limit import AirtimeLimit
from gr_ros2.phy.airtime import AirtimeGate
from gr_ros2.phy.base import Phy
from gr_ros2.phy.branch import Branch
from gr_ros2.phy.channel import PacketLoss
from gr_ros2.phy.delay import PacketDelay
from gr_ros2.phy.flowgraph import Flowgraph
from gr_ros2.phy.path import PacketPath
from gr_ros2.phy.window import CreditWindow
from gr_ros2.settings.airtime import AirtimeRule
from gr_ros2.settings.config import ChannelConfig


class SimulatedLink(PacketPath):
    """A path from a source's message port `pdus` to those of sinks, in a flowgraph that may have others.

    :param phy: which physical layer
    :param source: block with message port `pdus` out, whose PDUs it counts in ``emitted``
    :param sink: block with message port `pdus` in, which counts the processed PDUs in ``handled``
    :param channel: between transmitter and receiver
    :param throttled: packets pass at the rate of the channel (:class:`AirtimeGate`); False lets them pass as fast as
        the flowgraph takes them (:class:`CreditWindow`)
    :param paced: credits are granted to the source; False for a source without port `credit`. A PHY without samples
        has no airtime, so it does not set a rate
    :param rule: what limits the airtime; None = nothing
    :param delay_s: s that a packet takes beside its airtime
    :param instrumented: build in what the dashboard uses: packet loss that can be set on any PHY, a channel that can be
        changed, and taps for spectrum and constellation
    :param further: the channel and the sink of each further receiver
    :param within: the flowgraph; None: this object is one
    :param shared: whether the sink gets packets of other paths too, so that its counts say nothing of this one
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
        rule: AirtimeRule | None = None,
        delay_s: float = 0.0,
        instrumented: bool = False,
        further: Sequence[tuple[ChannelConfig, Any]] = (),
        within: Flowgraph | None = None,
        shared: bool = False,
    ) -> None:
        self.phy, self.source, self.sink = phy, source, sink
        self.channel = ChannelConfig() if channel is None else channel
        phy.check_channel(self.channel)
        self._within, self._shared = within, shared
        graph = self._flowgraph
        last = source
        if throttled and phy.has_airtime:
            airtime_of = phy.airtime if phy.any_length else None
            limit = None if rule is None else AirtimeLimit(rule, phy.airtime(), now=time.monotonic())
            self._gate = AirtimeGate(phy.airtime(), airtime_of=airtime_of, limit=limit, times=True)
            last = self._follow(last, self._gate)
        sent = self._transmit(last) if phy.has_samples else last
        self.branches = [self._branch(sent, *each) for each in further]
        """The further receivers."""
        if phy.has_samples:
            # The channel also stops tags.
            faded = instrumented or bool(self.channel.on_samples()) or phy.leaves_tags()
            self._receive(sent, faded=faded, shown=instrumented)
            last = self._receiver
        # A hier block with message ports keeps itself alive, and with it, for OFDM, 60 of the system's 4096 shared
        # memory segments.
        for hier_block in (self._transmitter, self._receiver, *self.branches):
            if hier_block is not None:
                weakref.finalize(graph, hier_block.release)
        if self.channel.loses_packets or instrumented or shared:
            self._loss = PacketLoss(self.channel)
            last = self._follow(last, self._loss)
        # Keep references, since GNU Radio holds none to a Python block.
        self._delay = PacketDelay(delay_s) if delay_s else None
        if self._delay is not None:
            last = self._follow(last, self._delay)
        self._follow(last, sink)
        self._pacer = self._gate if throttled else CreditWindow(self._progress)
        if paced and self._pacer is not None:
            source.use_credit()
            graph.msg_connect(self._pacer, "credit", source, "credit")

    def run_began(self, now: float) -> None:
        """Count the channel's outages from ``now`` (s, monotonic) instead of from the start of the flowgraph."""
        if self._loss is not None:
            self._loss.epoch = now
        for branch in self.branches:
            branch.run_began(now)

    def passed_at(self) -> Sequence[float]:
        """s, monotonic, when each packet passed the gate; () if there is no gate."""
        return () if self._gate is None else self._gate.passed_at

    def _branch(self, sent: Any, channel: ChannelConfig, sink: Any) -> Branch:
        """Connect a further receiver to a block that gives samples, or packets for a PHY without samples."""
        branch = Branch(self.phy, channel)
        if self.phy.has_samples:
            self._flowgraph.connect(sent, branch)
        else:
            self._follow(sent, branch)
        self._follow(branch, sink)
        return branch

    @property
    def _flowgraph(self) -> Any:
        return self if self._within is None else self._within

    def _offered(self) -> int:
        return int(self.source.emitted)

    def _handled(self) -> int:
        if self._shared and self._loss is not None:
            return self._loss.received - self._loss.dropped.total()
        return int(self.sink.handled)

    def _progress(self) -> int:
        """Packets that have passed the link, for the credit window."""
        if self._transmitter is None:
            first = self._handled() + (0 if self._loss is None else self._loss.dropped.total())
            return min([first, *(branch.received for branch in self.branches)])
        return int(self._transmitter.packets_sent())


class LoopbackLink(SimulatedLink, Flowgraph):
    """A flowgraph of one path; takes what that takes."""

    def __init__(self, phy: Phy, source: Any, sink: Any, **options: Any) -> None:
        Flowgraph.__init__(self, "gr_ros2_loopback", f"phy {phy.name}")
        super().__init__(phy, source, sink, **options)

    def start(self, max_noutput_items: int = 10_000_000) -> None:
        super().start(max_noutput_items)
        if self._gate is not None:
            self.phy.prefer_latency()
