"""What the blocks have in common that modulate packets: those of an allowed length are taken, others counted."""

from __future__ import annotations

import logging
from abc import abstractmethod
from collections.abc import Sequence
from typing import Any

import pmt

from gr_ros2.link.events import AirPacket
from gr_ros2.phy.pdus import octets, packets_of, take_messages
from gr_ros2.phy.threads import KeptAlive

_log = logging.getLogger(__name__)


class TakesPackets(KeptAlive):
    """Mix-in with message port `pdus` in, for a Python block inside a hier block; list it before GNU Radio's class.

    :param lengths: allowed bytes of a packet; any other PDU is dropped and counted
    :param args: arguments of GNU Radio's class
    """

    def __init__(self, lengths: range, *args: Any) -> None:
        super().__init__(*args)
        self._lengths = lengths
        self.refused = 0
        take_messages(self, "pdus", "_take", called="take")

    @abstractmethod
    def take_packets(self, packets: list[AirPacket]) -> None:
        """Process packets that came together."""

    def take(self, packets: Sequence[AirPacket]) -> None:
        """Packets have come."""
        good = [packet for packet in packets if len(packet.data) in self._lengths]
        self._refuse(len(packets) - len(good))
        self.take_packets(good)

    def _take(self, message: Any) -> None:
        bare = pmt.is_u8vector(message)
        packets, problem = ([AirPacket(octets(message))], "") if bare else packets_of(message)
        self._refuse(bool(problem))
        TakesPackets.take(self, packets)

    def _refuse(self, count: int) -> None:
        first = bool(count and not self.refused)
        self.refused += count
        if first:
            block: Any = self
            least, most = self._lengths[0], self._lengths[-1]
            needed = f"{most}" if least == most else f"{least} to {most}"
            _log.warning("%s: dropped a PDU that is not %s bytes", block.name(), needed)
