"""Writes packets: header, body, and the trailer that closes them; and counts and reports what leaves.

Invariants: each number is used once for a source packet, and each repair id once per number; packets have
``packet_len`` bytes at most, and exactly as many where all have the same length.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from typing import NamedTuple

from gr_ros2.link.events import AirKind, SenderEvent, SentEntry, SentPacket
from gr_ros2.link.rate import RateController
from gr_ros2.link.stats import SenderStats
from gr_ros2.link.v1.combining import Repair
from gr_ros2.link.v1.endpoint_settings import Settings
from gr_ros2.link.v1.hold import Hold
from gr_ros2.link.v1.lifetime import Lifetime
from gr_ros2.link.v1.repair import RepairWindow
from gr_ros2.link.v1.sealing import NOT_A_REPAIR, Checksum, Keys
from gr_ros2.settings.config import NOBODY
from gr_ros2.wire.v1 import (
    BROADCAST,
    QOS_REPAIR,
    EntryV1,
    Header,
    PacketV1,
    RepairHeader,
    body_room,
    write_body,
    write_header,
    write_repair_header,
)

HOP = 1
"""Hop count of addressed packets: robots send messages on, not packets."""


class SendSlot(NamedTuple):
    """When a packet is composed, and when it leaves.

    :param now: when it is composed, s
    :param leave_at: s, when its burst has to begin; None for as soon as possible
    :param block: tells others about slots, see :mod:`gr_ros2.wire.mac_block`; empty where the channel is not shared
    """

    now: float
    leave_at: float | None = None
    block: bytes = b""


class PacketWriter:
    """Writes the packets of one robot.

    :param keys: keys that seal them
    :param window: records what may be repaired, and gives out repair ids
    :param rate: chooses the MCS of each packet; None for a fixed rate
    :param stats: counts what leaves
    :param hold: is told of new packets
    :param observer: called with every packet
    :param shares: packets carry blocks for medium access
    :ivar room: bytes of the longest body
    :ivar sealed: whether packets are sealed
    """

    def __init__(
        self,
        settings: Settings,
        boot: int,
        keys: Keys,
        window: RepairWindow,
        *,
        rate: RateController | None,
        stats: SenderStats,
        hold: Hold,
        observer: Callable[[SenderEvent], None] | None,
        shares: bool = False,
    ) -> None:
        self._src_id, self._boot, self._dst_id = settings.src_id, boot, settings.dst_id
        self._hop = HOP if settings.dst_id != BROADCAST else 0
        self._window, self._rate, self._stats, self._hold, self._observer = window, rate, stats, hold, observer
        self.sealed, self._encrypts = keys.sealed, keys.encrypts
        self.room = room_of(settings, keys, block=shares)
        self._end_of_body = 0 if settings.any_length else settings.packet_len - keys.trailer_len
        """Number of bytes to which the packet with its padded body extends."""
        # An end without an id only listens and closes no packet. Its id makes no key.
        self._trailer = Checksum(boot) if settings.src_id == NOBODY else keys.own(settings.src_id, boot)

    @property
    def newest(self) -> int:
        """The number of the newest source packet."""
        return self._window.packets.newest

    def source(
        self,
        entries: list[EntryV1],
        lifetimes: tuple[Lifetime, ...],
        qos: int,
        parts: tuple[SentEntry, ...],
        slot: SendSlot,
        *,
        robots: frozenset[int] | None = None,
        skipped: int = 0,
    ) -> SentPacket:
        """Write a packet with a number of its own.

        :param lifetimes: of the messages in it; () for a packet that is not worth repairing
        :param parts: what it carries of messages that are sent for the first time
        :param robots: those for whom it is; None for all
        :param skipped: the bits of the others
        """
        number = self._window.packets.newest + 1
        body = write_body(entries, self.room)
        sent = self._close(qos, number, None, body, entries, kind="new", slot=slot, parts=parts, robots=robots)
        self._window.sent(number, body, lifetimes, slot.now, skipped=skipped)
        if lifetimes:
            self._hold.left(slot.now, self._window.peers.loss)
        return sent

    def control(self, entries: Sequence[EntryV1], kind: AirKind, slot: SendSlot, *, clear: bool = False) -> SentPacket:
        """Write a packet of entries that are not messages; it stands at the newest number."""
        window = self._window
        repair_id = window.packets.take_repair_id(window.packets.newest)
        if repair_id is None:
            return self.source([], window.exhausted(slot.now), 0, (), slot)
        body = write_body(entries, self.room)
        fields = RepairHeader(repair_id, oldest=not window.packets.unconfirmed(slot.now), clear=clear)
        return self._close(QOS_REPAIR, window.packets.newest, fields, body, entries, kind=kind, slot=slot)

    def repair(self, chosen: Repair, slot: SendSlot, robots: Collection[int] | None = None) -> SentPacket:
        """Write a combination of packets.

        :param robots: those who lack it; None where that is to be heard by all
        """
        number, mask, repair_id, oldest, combined = chosen
        fields = RepairHeader(repair_id, mask, oldest)
        return self._close(QOS_REPAIR, number, fields, combined, (), kind="repair", slot=slot, robots=robots)

    def _close(
        self,
        qos: int,
        number: int,
        repair: RepairHeader | None,
        body: bytes,
        entries: Sequence[EntryV1],
        *,
        kind: AirKind,
        slot: SendSlot,
        parts: tuple[SentEntry, ...] = (),
        robots: Collection[int] | None = None,
    ) -> SentPacket:
        """Pad and seal a packet, which leaves."""
        header = Header(qos, self.sealed, self._src_id, number & 0xFFFF, self._dst_id, self._hop, slot.block)
        clear, repair_id, combined, plain = write_header(header), NOT_A_REPAIR, b"", False
        if repair is not None:
            clear += write_repair_header(repair)
            repair_id, plain = repair.repair_id, repair.clear
        body = body.ljust(self._end_of_body - len(clear), b"\0")
        if repair is not None and repair.mask:
            combined = body
        data = self._trailer.close(clear, body, number, repair_id, plain=plain)
        packet = PacketV1(header, tuple(entries), repair, combined, self._encrypts and not plain)
        stats = self._stats
        stats.air[kind] += 1
        stats.packets += 1
        mcs = 0
        if self._rate is not None:
            mcs = self._rate.sent(robots if self._dst_id == BROADCAST else (self._dst_id,), slot.now)
            if kind in {"hello", "report"}:  # they are also for robots that are not known yet
                mcs = 0
        sent = SentPacket(
            data, packet, self._src_id, self._boot, number, repair_id, parts, slot.now, kind, mcs, slot.leave_at
        )
        if self._observer is not None:
            self._observer(sent)
        return sent


def room_of(settings: Settings, keys: Keys, *, block: bool) -> int:
    """Bytes of the longest body that a robot sends."""
    return body_room(settings.packet_len, sealed=keys.sealed, addressed=settings.dst_id != BROADCAST, block=block)
