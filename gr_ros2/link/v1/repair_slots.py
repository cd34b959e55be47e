"""When repairs leave: before new messages, in a slot that nothing else needs, or later because a message is due.

Which repair it is says ``repair``.
"""

from __future__ import annotations

from math import inf

from gr_ros2.link.events import SentPacket
from gr_ros2.link.pace import Pace
from gr_ros2.link.v1.audiences import Audiences
from gr_ros2.link.v1.combining import Repair
from gr_ros2.link.v1.endpoint_settings import Settings
from gr_ros2.link.v1.hold import Hold
from gr_ros2.link.v1.packing import Packing
from gr_ros2.link.v1.repair import RepairWindow
from gr_ros2.link.v1.shared import in_a_row
from gr_ros2.link.v1.writer import PacketWriter, SendSlot
from gr_ros2.wire.control import LeftOut


class RepairSlots:
    """The slots of one sender that carry repairs."""

    def __init__(
        self,
        settings: Settings,
        pace: Pace,
        window: RepairWindow,
        *,
        writer: PacketWriter,
        hold: Hold,
        audiences: Audiences | None = None,
    ) -> None:
        self._audiences = audiences
        self._settings, self._tuning = settings, settings.tuning
        self._pace, self._window, self._writer, self._hold = pace, window, writer, hold
        self._waits_until = -inf
        """Time in s up to which repairs wait, because a new message is about to come; -inf to look anew."""
        self._calm_since = -inf
        """Time in s at which no repair was wanted, if no report has come since; otherwise -inf."""
        self._calm_number = 0
        """The newest packet then."""
        self._ahead, self._number = 0, 0
        """Repairs that may go before new messages, and the newest packet when that was counted."""
        self._yielded = 0
        """Times that a repair has let messages of class latency go first since none of these waited."""
        self._repaired = -1
        """The newest packet when a repair went first."""

    def look_anew(self) -> None:
        """A robot was heard: what repairs wait for may be another message now."""
        self._waits_until = -inf

    def reported(self) -> None:
        """A report has come."""
        self._calm_since = -inf

    def first(self, slot: SendSlot, packing: Packing) -> SentPacket | None:
        """What goes before new messages: what a receiver lacks or waits for in vain, so that later messages wait.

        :param packing: knows which messages wait
        """
        if not self._window.pressing:
            return None
        now, newest = slot.now, self._window.packets.newest
        if not packing.urgent:
            self._yielded = 0
        elif self._yielded < self._tuning.repair_yields:
            self._yielded += 1
            return None
        elif newest == self._repaired:
            return None
        waiting = packing.next_timeout(now) <= now
        if waiting:
            more = (newest - self._number) * in_a_row(self._window.peers.loss, self._tuning.shared_kept_up)
            self._ahead = min(self._ahead + more, self._tuning.repair_most_ahead)
            self._number = newest
            if not self._ahead:
                return None
        given_up = self._window.peers.given_up(now, self._tuning.repair_patience_s * self._settings.slower)
        if given_up < 0 or not self._window.may_tell(waiting=waiting):
            again = self._window.urgent(now)
            if again is not None:
                self._ahead -= waiting
                self._repaired = newest
                return self._writer.repair(again, slot, self._lacking(again))
        if given_up < 0:
            return None
        self._repaired = newest
        return self._tell(given_up, slot)

    def spare(self, slot: SendSlot) -> SentPacket | None:
        """What a slot carries that nothing else needs."""
        now = slot.now
        if self._window.peers.in_vain and (given_up := self._window.peers.given_up(now)) >= 0:
            return self._tell(given_up, slot)
        self._waits_until = -inf
        if self._audiences is not None and (late := self._late(self._audiences, slot)) is not None:
            return late
        chosen = self._window.next(now, self.held)
        held = self._waits_until > now
        self._calm_since = now if chosen is None and not held else -inf
        self._calm_number = self._window.packets.newest
        if chosen is not None:
            self._hold.repaired(waiting=held)
            return self._writer.repair(chosen, slot, self._lacking(chosen))
        lifetimes = () if held else self._window.exhausted(now)
        return self._writer.source([], lifetimes, 0, (), slot) if lifetimes else None

    def next(self, now: float, *, waiting: bool = False) -> float:
        """When ``spare`` may have something, s; inf for never.

        :param waiting: something else waits for such a slot
        """
        if waiting or (self._audiences is not None and self._audiences.due(now) is not None):
            return max(self._waits_until, now)
        mode = self._window.mode
        if mode == "off" or not self._window.wanted(now):
            return inf
        return max(self._waits_until, now if mode == "idle" else self._next_look(now))

    def _late(self, audiences: Audiences, slot: SendSlot) -> SentPacket | None:
        """What was sent too fast for some, sent as they hear it."""
        record = audiences.due(slot.now)
        if record is None:
            return None
        peers = self._window.peers
        robots = [src_id for src_id, peer in peers.all.items() if record.skipped & peer.bit]
        # It takes longer than what others wait for, and is owed to no loss.
        if self.held(slot.now, repairs=False, airtime=audiences.airtime_s(robots, slot.now)):
            return None
        self._hold.left_instead()
        again = self._window.complete(record, slot.now)
        return None if again is None else self._writer.repair(again, slot, robots)

    def _lacking(self, chosen: Repair) -> list[int] | None:
        """Those who lack a packet that is repaired alone, where not all packets are for all; None for all."""
        if self._audiences is None or chosen.mask != 1 or not self._window.packets.parts:
            return None
        return self._window.peers.lacking(self._window.packets.records[chosen.number]) or None

    def _tell(self, number: int, slot: SendSlot) -> SentPacket | None:
        """Say that a packet is not repaired any more."""
        told = self._window.tell(number, slot.now)
        if isinstance(told, LeftOut):
            return self._writer.control([told], "repair", slot)
        if told is not None:
            return self._writer.repair(told, slot)
        return None if self._window.packets.unconfirmed(slot.now) else self._writer.control([], "repair", slot)

    def _next_look(self, now: float) -> float:
        """When a thrifty sender may want to repair something."""
        window, since = self._window, self._calm_since
        if not window.peers.loss:
            return min(now + self._tuning.repair_calm_poll_s, window.thrift.next_doubt(since))
        if since == -inf or window.packets.newest != self._calm_number:
            return now
        return min(now + self._tuning.repair_poll_s, window.thrift.next_doubt(since))

    def held(self, now: float, *, repairs: bool = True, airtime: float = 0.0) -> bool:
        """Whether what could leave now, a repair or something else, waits for a new message.

        :param airtime: that it takes, s; 0 = as much as other packets lately
        """
        usual = self._pace.interval
        end = self._pace.free(now) + (airtime or usual)
        self._waits_until = self._hold.until(now, end, usual, repairs=repairs)
        return self._waits_until > now
