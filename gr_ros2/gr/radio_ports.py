"""The message ports over which the packets of a robot leave: all to its one radio, or each to some of several."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

import pmt

from gr_ros2.link import AirPacket, SentPacket
from gr_ros2.link.bond import Bond
from gr_ros2.phy.pdus import PduPort, pdu_to_send, port_of
from gr_ros2.settings.fields import AUTO
from gr_ros2.settings.registry import Registry
from gr_ros2.wire import QOS_LATENCY, Packet

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


class RadioPorts:
    """The ports `pdus` of a block, one for each radio.

    :param block: whose they are
    :param radios: how many
    :param bond: chooses the radios of each packet, where there are several
    :param lock: guards the bond
    :param registry: the topics that are sent now
    """

    def __init__(
        self, block: Any, radios: int, bond: Bond | None, lock: threading.Lock, registry: Callable[[], Registry]
    ) -> None:
        self._ports = [PduPort(block, port_of("pdus", radio)) for radio in range(radios)]
        self._sending = [threading.Lock() for _ in self._ports]
        """Two threads send over a radio that another endpoint has alone; what is behind the port knows one."""
        self._bond, self._lock, self._registry = bond, lock, registry
        self._pdus = PduMaker()
        self.left: Callable[[int, Sequence[SentPacket]], None] = lambda _radio, _packets: None
        """Called with a radio and the packets that have left over it, without the lock."""

    def find_readers(self) -> bool:
        """Find what reads the ports; returns whether something reads each of them."""
        readers = [port.find_readers() for port in self._ports]  # of all, even where one has none
        return all(readers)

    def send(self, packets: list[SentPacket], *, adaptive: bool) -> None:
        """Send packets. Called without a lock.

        :param adaptive: whether each says its MCS
        """
        if self._bond is None:
            self._send_over(0, packets, adaptive)
            self.left(0, packets)
            return
        shares: list[list[SentPacket]] = [[] for _ in self._ports]
        with self._lock:
            for sent in packets:
                for radio in self._bond.leave(everywhere=self._everywhere(sent)):
                    shares[radio].append(sent)
        for radio, share in enumerate(shares):
            self._send_over(radio, share, adaptive)
            self.left(radio, share)

    def send_bound(self, radio: int, packets: list[SentPacket], mark: bytes, *, adaptive: bool) -> None:
        """Send packets of the endpoint that has one radio alone. Called without a lock.

        :param mark: what stands before each
        """
        marked = [sent._replace(data=mark + sent.data) for sent in packets] if mark else packets
        self._send_over(radio, marked, adaptive)

    def _send_over(self, radio: int, packets: list[SentPacket], adaptive: bool) -> None:
        port = self._ports[radio]
        on_air = [AirPacket(sent.data, None, sent.leave_at, sent.mcs if adaptive else None) for sent in packets]
        with self._sending[radio]:
            if port.direct:
                port.send(on_air)
            else:
                wall = time.time()
                for sent, packet in zip(packets, on_air, strict=True):
                    port.send_pdu(self._pdus.pdu(sent.packet, packet, wall))

    def _everywhere(self, sent: SentPacket) -> bool:
        """Whether a packet leaves over all radios."""
        if sent.kind in ("hello", "report"):
            return True
        registry = self._registry()
        via = {registry[entry.topic_id].options.via for entry in sent.entries if entry.topic_id < len(registry)}
        return "all" in via or (sent.packet.qos == QOS_LATENCY and AUTO in via)
