"""The source packets of one sender that are still worth repairing.

A packet is *alive* until every peer that reports has confirmed it, or until all messages in it are over: late, or
replaced by newer ones. Packets with messages that are delivered in order are kept for peers that are out of range,
too. *Needed* is a packet only by those that are here, or, where none is, by whoever may hear it, until it was repaired
often enough for them.

Invariants: a repair id is used once per number; no live packet is more than ``span`` numbers old.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from gr_ros2.link.v1.lifetime import Lifetime
from gr_ros2.wire.control import MAP, LeftOut
from gr_ros2.wire.v1 import REPAIR_IDS, SPAN

_ALL_USED = (1 << REPAIR_IDS) - 1
_PARTED = 1024
"""Newest packets of which it is known whether they were sent to all."""


@dataclass(slots=True, eq=False)
class Sent:
    """A source packet that left.

    :param at: when it was last sent, or repaired alone, s
    :param confirmed: one bit per peer
    :param skipped: bits of the peers for which it was sent too fast, as far as they have not got it since
    :param parted: bits of those for which it was sent too fast at first
    :param covered: number of repairs of it while nobody reported, divided by the number that is enough
    """

    number: int
    body: bytes
    lifetimes: tuple[Lifetime, ...]
    at: float
    confirmed: int = 0
    skipped: int = 0
    parted: int = 0
    covered: float = 0.0

    @property
    def in_order(self) -> bool:
        """Whether a message in it is delivered in order, and kept for who is out of range."""
        return any(lifetime.in_order and not lifetime.chained for lifetime in self.lifetimes)

    def alive(self, now: float) -> bool:
        """Whether a message in it is still worth something."""
        for lifetime in self.lifetimes:  # noqa: SIM110 - any() with a generator takes three times as long
            if now < lifetime.expires:
                return True
        return False

    def lasts(self, now: float) -> bool:
        """Whether a message in it is worth something that the next message of its topic does not replace."""
        return any(now < lifetime.expires and not lifetime.fresh for lifetime in self.lifetimes)


class SentPackets:
    """What a sender keeps of its packets.

    :param span: numbers that are kept at most
    :param shares: whether others send on the same channel
    :ivar newest: number of the last source packet; 0 before the first
    :ivar oldest: no older packet is kept
    :ivar records: all packets from ``oldest`` on that may be alive, by number and in this order
    :ivar needed: none before this is needed
    :ivar everybody: the bits of all peers that report
    :ivar away: the bits of those that did and are out of range
    :ivar parted: the newest packets that were first sent so that not all peers hear them. They carry nothing that is
        delivered in order
    :ivar told: the newest packet of which peers were told that they need not wait for it
    :ivar told_of: the packets of which they were told last whether they need to
    """

    def __init__(self, span: int = SPAN, *, shares: bool = False) -> None:
        self.newest = self.oldest = self.needed = 0
        self.records: dict[int, Sent] = {}
        self.everybody = self.away = 0
        self.parted: set[int] = set()
        self.told = 0
        self.told_of = range(0)
        self._span, self._shares = span, shares
        self._repair_ids: dict[int, int] = {}
        """Repair ids already used, as bits, by number."""
        self._repair_id = 0

    def add(self, number: int, body: bytes, lifetimes: tuple[Lifetime, ...], now: float, *, skipped: int = 0) -> None:
        """A source packet left.

        :param skipped: the peers for which it was sent too fast
        """
        self.newest = number
        if skipped:
            self.parted.add(number)
        if self.parted:
            self.parted.discard(number - _PARTED)
        if self.records or lifetimes:
            if not self.records:
                self.oldest = self.needed = number
            record = self.records[number] = Sent(number, body, lifetimes, now)
            if skipped:
                record.skipped = record.parted = skipped
            if self.away and not record.in_order:
                record.confirmed = self.away
            if number - self.oldest >= self._span:
                first = number - self._span + 1
                for old in range(self.oldest, first):
                    self.records.pop(old, None)
                self.oldest = first

    def here(self, bit: int) -> None:
        """A peer reports."""
        self.everybody |= bit
        self.away &= ~bit
        self.needed = self.oldest

    def leave(self, bit: int) -> None:
        """A peer is out of range."""
        self.everybody &= ~bit
        self.away |= bit
        for record in self.records.values():
            record.skipped &= ~bit
            record.parted &= ~bit
            if not record.in_order:
                record.confirmed |= bit

    def forget(self, bit: int) -> None:
        """A peer is gone for good."""
        self.everybody &= ~bit
        self.away &= ~bit
        for record in self.records.values():
            record.confirmed &= ~bit
            record.skipped &= ~bit
            record.parted &= ~bit

    def retire(self, now: float) -> None:
        """Forget the oldest packets that are not alive."""
        records, away, here = self.records, self.away, self.everybody
        oldest, everybody = self.oldest, here | away
        while oldest <= self.newest:
            record = records.get(oldest)
            if record is not None:
                lacking = record.confirmed & everybody != everybody or not (here or record.covered >= 1)
                if lacking and record.alive(now):
                    break
                del records[oldest]
            oldest += 1
        self.oldest = oldest
        needed = self.needed if away and self.needed > oldest else oldest
        while away and needed <= self.newest:
            record = records.get(needed)
            if record is not None and record.alive(now):
                served = record.confirmed & here == here if here else record.covered >= 1
                if not served:
                    break
            needed += 1
        self.needed = needed

    def first_lacked(self, bit: int, first: int, last: int, lifetime: Lifetime) -> int:
        """The first packet of a message that the peer of a bit has not confirmed, as far as it may still be repaired;
        ``last + 1`` if there is none.

        :param first, last: the packets that carry the message
        """
        for number in range(max(first, self.oldest), last + 1):
            record = self.records.get(number)
            if record is not None and not record.confirmed & bit and lifetime in record.lifetimes:
                return number
        return last + 1

    @property
    def parts(self) -> bool:
        """Whether some of the newest packets were not sent to all."""
        return bool(self.parted) and any(
            number in self.parted for number in range(self.newest - MAP + 1, self.newest + 1)
        )

    def left_out(self, now: float, first: int = 0) -> LeftOut:
        """What peers are told of packets that they need not wait for.

        :param first: the first packet of interest
        """
        self.retire(now)
        records, newest = self.records, min(self.newest, first + MAP - 1) if first else self.newest
        packets = 0
        for back in range(MAP):
            record = records.get(newest - back)
            if record is None or not self.repaired(record, now) or newest - back in self.parted:
                packets |= 1 << back
        settled = self.oldest > newest - MAP
        self.told = max(self.told, newest)
        self.told_of = range(0 if settled else newest - MAP + 1, newest + 1)
        return LeftOut(newest & 0xFFFF, packets, settled)

    def repaired(self, record: Sent, now: float) -> bool:
        """Whether a packet is repaired: on a channel that others share, not for what the next message replaces."""
        return record.lasts(now) if self._shares else record.alive(now)

    def unconfirmed(self, now: float) -> bool:
        """Whether anything is alive."""
        self.retire(now)
        return bool(self.records)

    def wanted(self, now: float) -> bool:
        """Whether anything is needed."""
        self.retire(now)
        return self.needed <= self.newest

    def live(self, first: int, last: int, now: float) -> list[Sent]:
        """The packets from one number to another that are alive, and were sent to all."""
        found: list[Sent] = []
        records, here, everybody = self.records, self.everybody, self.everybody | self.away
        kept: Iterable[Sent] = records.values()
        if first > self.oldest or last < self.newest:
            kept = [records[number] for number in range(first, last + 1) if number in records]
        for record in kept:
            if record.confirmed & everybody == everybody and (here or record.covered >= 1):
                continue
            for lifetime in record.lifetimes:  # ``alive``, whose call would take half of this loop's time
                if now < lifetime.expires:
                    found.append(record)
                    break
        return [record for record in found if not record.skipped] if self.parted else found

    def take_repair_id(self, number: int) -> int | None:
        """A repair id that no repair packet at this number has used; None if all are used."""
        used = self._repair_ids.get(number, 0)
        if used == _ALL_USED:
            return None
        repair_id = self._repair_id
        while used >> repair_id & 1:
            repair_id = (repair_id + 1) % REPAIR_IDS
        self._repair_ids[number] = used | 1 << repair_id
        self._repair_id = (repair_id + 1) % REPAIR_IDS
        if len(self._repair_ids) > 2 * self._span:
            for old in [old for old in self._repair_ids if old < number - self._span]:
                del self._repair_ids[old]
        return repair_id

    def full(self, number: int) -> bool:
        """Whether no further repair packet can stand at a number."""
        return self._repair_ids.get(number, 0) == _ALL_USED
