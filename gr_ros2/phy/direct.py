"""The `direct` PHY: a message port from source to sink, no samples, no airtime, no loss of its own."""

from __future__ import annotations

from typing import Any

from gr_ros2.errors import PhyError
from gr_ros2.phy.base import PacketReceiver, PacketTransmitter, Phy


class DirectPhy(Phy):
    """Packets cross on the message port itself (the paper's direct loopback).

    :raises ConfigError: for any option, since there are none
    """

    name = "direct"
    has_samples = False
    has_airtime = False

    def __init__(self, packet_len: int, sample_rate: float = 0.0, **options: Any) -> None:
        super().__init__(packet_len, sample_rate, **options)

    def airtime_samples(self, packet_len: int | None = None) -> int:  # noqa: ARG002
        return 0

    def burst_power(self) -> float:
        return 0.0

    def transmitter(self) -> PacketTransmitter:
        raise PhyError("phy direct has no transmitter; connect the source's `pdus` to the sink's")

    def receiver(self, own_process: bool = False) -> PacketReceiver:  # noqa: ARG002
        raise PhyError("phy direct has no receiver; connect the source's `pdus` to the sink's")
