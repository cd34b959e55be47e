"""Packets to PDUs with metadata.

Invariant: metadata is for people and other blocks, except for the MCS of an adaptive rate and the time to leave, which
transmitters read.
"""

from __future__ import annotations

from typing import Any

import pmt

from gr_ros2.link.events import AirPacket
from gr_ros2.phy.pdus import pdu_to_send
from gr_ros2.wire import Packet

_SRC, _DST, _SEQ, _QOS, _WALL = (pmt.intern(name) for name in ("src_id", "dst_id", "seq", "qos", "t_src_wall"))


class PduMaker:
    """Makes PDUs from packets, and caches the metadata that repeats."""

    def __init__(self) -> None:
        self._metadata: dict[tuple[int, int, int], Any] = {}

    def pdu(self, packet: Packet, on_air: AirPacket, wall: float) -> Any:
        """One packet as a PDU.

        :param packet: its meaning
        :param on_air: its bytes, and how and when they leave
        :param wall: s since 1970, for ``t_src_wall``
        """
        header = (packet.src_id, packet.dst_id, packet.qos)
        metadata = self._metadata.get(header)
        if metadata is None:
            metadata = self._metadata[header] = _header_metadata(header)
        metadata = pmt.dict_add(metadata, _SEQ, pmt.from_long(packet.seq))
        metadata = pmt.dict_add(metadata, _WALL, pmt.from_double(wall))
        return pdu_to_send(on_air, metadata)


def _header_metadata(header: tuple[int, int, int]) -> Any:
    metadata = pmt.make_dict()
    for key, value in zip((_SRC, _DST, _QOS), header, strict=True):
        metadata = pmt.dict_add(metadata, key, pmt.from_long(value))
    return metadata
