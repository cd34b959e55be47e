"""The `direct` PHY: a message port from source to sink, no samples, no airtime, no loss of its own."""

from __future__ import annotations

from gr_ros2.phy.base import PacketPhy


class DirectPhy(PacketPhy):
    """Packets cross on the message port itself (the paper's direct loopback).

    :raises ConfigError: for any option, since there are none
    """

    name = "direct"
    has_airtime = False
    crossing = "connect the source's `pdus` to the sink's"
