"""A further receiver of a simulated link: what the transmitter sends reaches it through a channel of its own.

Invariant: what happens here changes nothing at the other receivers.
"""

from __future__ import annotations

from typing import Any

from gnuradio import gr

from gr_ros2.phy.base import Phy
from gr_ros2.phy.channel import PacketLoss
from gr_ros2.phy.flowgraph import HierBlock
from gr_ros2.phy.path import PacketPath
from gr_ros2.settings.config import ChannelConfig


class Branch(PacketPath, HierBlock):
    """Channel, receiver and losses. Message port `pdus` out.

    The input is the transmitter's samples, or message port `pdus` for a PHY without samples.

    :param phy: which physical layer
    :param channel: between the transmitter and this receiver
    :raises ConfigError: for a channel that this PHY does not support
    """

    def __init__(self, phy: Phy, channel: ChannelConfig) -> None:
        samples = gr.io_signature(1, 1, gr.sizeof_gr_complex) if phy.has_samples else gr.io_signature(0, 0, 0)
        super().__init__("gr_ros2_branch", samples, gr.io_signature(0, 0, 0))
        self.message_port_register_hier_out("pdus")
        self.phy, self.channel = phy, channel
        phy.check_channel(channel)
        last: Any = self
        if phy.has_samples:
            self._receive(self, faded=bool(channel.on_samples()) or phy.leaves_tags(), shown=False)
            last = self._receiver
        else:
            self.message_port_register_hier_in("pdus")
        self._loss = PacketLoss(channel)
        self._follow(self._follow(last, self._loss), self)

    def run_began(self, now: float) -> None:
        """Count the channel's outages from ``now`` (s, monotonic) instead of from the start of the flowgraph."""
        assert self._loss is not None
        self._loss.epoch = now

    @property
    def received(self) -> int:
        """Packets that came out of the receiver, those lost on purpose afterwards included."""
        assert self._loss is not None
        return self._loss.received

    def release(self) -> None:
        if self._receiver is not None:
            self._receiver.release()
        super().release()
