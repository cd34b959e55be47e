"""What an idle slot carries: the sender's side of repair.

*The rule.* New packets go first, except that a packet which a report names as lost, and for which later messages wait,
goes before them. In a slot without a new packet:

1. if there is one peer and its reports name a lost packet that is still alive, that packet is repaired alone; the
   newest such packet goes first;
2. otherwise the slot carries a linear combination over GF(256) of live packets (``combining``). A thrifty sender sends
   it only if it is worth the slot (``thrift``).

A packet that is repaired alone is a combination of one, and never the same packet again: a receiver that has heard
nothing since would take it for new, and a command in it for fresh.

What is alive says ``sent_packets``, what reports tell ``peers``, and what holds while nobody reports ``unreported``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import inf
from typing import Literal

from gr_ros2.core.tuning import Tuning
from gr_ros2.link.pace import Pace
from gr_ros2.link.v1.combining import Combining, Repair
from gr_ros2.link.v1.lifetime import Lifetime
from gr_ros2.link.v1.peers import REACH, Peers
from gr_ros2.link.v1.sent_packets import Sent, SentPackets
from gr_ros2.link.v1.shared import SharedRepairs
from gr_ros2.link.v1.thrift import Thrift
from gr_ros2.link.v1.unreported import Unreported
from gr_ros2.settings.fields import AUTO, Auto
from gr_ros2.wire.control import LeftOut
from gr_ros2.wire.v1 import SPAN

RepairMode = Literal["idle", "thrifty", "off"]


def _never(_now: float) -> bool:
    return False


class RepairWindow:
    """The choice of repairs of one sender.

    :param repair: the setting: a mode, or auto, which is thrifty where somebody reports and idle where nobody does,
        within bounds where somebody did
    :param room: bytes of the longest body
    :param expected_loss: share of packets lost, used until a report arrives
    :param shares: whether others send on the same channel
    :param proves, slower: see :class:`Unreported`
    :param pace: says whether anything limits how many packets leave; None: something does
    :ivar packets: what has left and may be repaired
    :ivar peers: what reports tell of them
    :ivar thrift: when a report is overdue
    """

    def __init__(
        self,
        repair: RepairMode | Auto,
        room: int,
        expected_loss: float = 0.0,
        span: int = SPAN,
        *,
        shares: bool = False,
        proves: bool = False,
        slower: float = 1.0,
        pace: Pace | None = None,
        tuning: Tuning = Tuning(),
    ) -> None:
        self._repair, self._pace = repair, pace
        self.packets = SentPackets(span, shares=shares)
        self._unreported = Unreported(expected_loss, tuning, proves=proves, slower=slower)
        self._shared = SharedRepairs(self.packets, tuning) if shares else None
        self.peers = Peers(self.packets, self._unreported, tuning, self._shared, slower=slower)
        self.thrift = Thrift(self.packets, self.peers, tuning)
        self._combining = Combining(self.packets, room, tuning)
        self._no_place = False
        """Whether the last combination could stand at no packet."""

    def sent(self, number: int, body: bytes, lifetimes: tuple[Lifetime, ...], now: float, *, skipped: int = 0) -> None:
        """A source packet left.

        :param body: its entries, without padding
        :param lifetimes: lifetimes of the messages in it; () for a packet that is not worth repairing
        :param skipped: bits of the peers for which it was sent too fast
        """
        self.peers.sent(number, lifetimes, now)
        if not self.peers.all:
            self._unreported.sent(number, lifetimes)
        elif self._shared is not None:
            self._shared.sent(number, lifetimes, self.peers.loss)
        self.packets.add(number, body, lifetimes, now, skipped=skipped)

    @property
    def mode(self) -> RepairMode:
        """What idle slots carry now: ``idle``, as many repairs as there are slots; ``thrifty``, as many as losses are
        known or expected; ``off``, none."""
        if self._pace is not None and not self._pace.known:  # repair only what reports call for
            return "thrifty" if self._repair != "off" and self.peers.all else "off"
        if self._repair != AUTO:
            return self._repair
        return "thrifty" if self.peers.all else "idle"

    def next(self, now: float, held: Callable[[float], bool] = _never) -> Repair | None:
        """What an idle slot carries: a combination or nothing.

        :param held: whether a repair has to wait, at this time in s; only asked if there is one. A thrifty sender has
            few repairs under way: what a report names as lost does not wait then
        """
        mode = self.mode
        if mode == "off" or not self.wanted(now):
            return None
        thrifty = mode == "thrifty"
        if self._shared is not None and self.peers and (again := self._urgent_of_all(now, idle=True)) is not None:
            return again
        if thrifty and (lost := self.peers.lost(now)) is not None:
            return self._alone(lost, now)
        window = self._combining.window(now)
        if not window or (thrifty and not self.thrift.worth(window, now)):
            return None
        if held(now) and not (thrifty and self.peers.lack(window)):
            return None
        if not thrifty and (lost := self.peers.lost(now)) is not None:
            return self._alone(lost, now)
        return self._combination(window, now)

    def wanted(self, now: float) -> bool:
        """Whether anything is to be repaired in idle slots. While all peers are out of range, no more than who hears
        and is not heard needs."""
        bounded = self.peers.gone and self._repair == AUTO
        return not (bounded and not self._unreported.spares) and self.packets.wanted(now)

    def urgent(self, now: float) -> Repair | None:
        """What goes before new packets, because later messages wait for it: a packet that a report names as lost, or,
        where there are no reports, a repair of a long message over the newest packets."""
        if self.mode == "off":
            return None
        if self._shared is not None and self.peers:
            return self._urgent_of_all(now)
        again = self.peers.urgent(now)
        if again is not None:
            return self._bring(again, now)
        if not self._unreported.due(self.packets.newest):
            return None
        self.packets.retire(now)
        window = self._combining.window(now)
        if not window:
            self._unreported.end()
            return None
        return self._combination(window, now)

    def may_tell(self, *, waiting: bool) -> bool:
        """Whether a peer may be told now what is not repaired any more, before what is urgent.

        :param waiting: whether something new waits
        """
        return self._shared is not None and self._shared.may_leave(idle=not waiting)

    @property
    def pressing(self) -> bool:
        """Whether ``urgent`` or ``Peers.given_up`` may have something."""
        if self._shared is not None and self._shared.due:
            return True
        peers = self.peers
        if peers.all:
            return peers.in_vain or peers.any_urgent
        return self._unreported.due(self.packets.newest)

    def tell(self, number: int, now: float) -> Repair | LeftOut | None:
        """What tells peers that a packet is not repaired any more, or brings it back; None if there is nothing."""
        packets = self.packets
        if packets.parts:
            return self._left_out(number, now)
        packets.retire(now)
        if self._shared is None:
            self.peers.announced(range(packets.newest + 1))
            window = self._combining.around(number, now)
        else:
            window = self._combining.fitting(self._shared.window(now, number), number)
            if not window or number not in self._shared.spanned(window):
                return self._left_out(number, now)
            self._combines(window, now)
        spans = bool(window) and window[0].number >= number >= window[-1].number
        record = packets.records.get(number)
        if record is not None and (not spans or self.peers.replayed(number)):
            if not record.alive(now):  # it would be taken for one that is of use
                return self._left_out(number, now)
            window = [record]
        return self._combination(window, now) if window else None

    def exhausted(self, now: float) -> tuple[Lifetime, ...]:
        """The lifetimes of the newest live packet, if no further repair can stand at the newest number and something is
        alive; otherwise (). A packet with these lifetimes and no content makes room for repairs."""
        packets = self.packets
        if self._no_place or packets.full(packets.newest) or packets.newest <= self.peers.proven:
            self._no_place = False
            for number in range(packets.newest, packets.needed - 1, -1):
                record = packets.records.get(number)
                if record is not None and record.alive(now):
                    return record.lifetimes
        return ()

    def _urgent_of_all(self, now: float, *, idle: bool = False) -> Repair | None:
        """What goes before new packets on a shared channel."""
        assert self._shared is not None
        if not self._shared.may_leave(idle=idle):
            return None
        again = self.peers.urgent(now)
        if again is not None:
            return self._bring(again, now)
        return self._for_all(now) if self._shared.due else None

    def _for_all(self, now: float, lost: int = -1) -> Repair | None:
        """A combination of all that is alive, which brings one packet back to each peer.

        :param lost: a packet that it contains, -1 for none
        """
        window = self._of_all(now, lost, self.peers.needed_from)
        self.peers.served(window)
        return self._combination(window, now) if window else None

    def _of_all(self, now: float, lost: int, first: int = 0) -> list[Sent]:
        """The window of a combination of all that is worth one, from a packet on, around a lost one unless it is -1."""
        assert self._shared is not None
        window = [record for record in self._shared.window(now, lost) if record.number >= first]
        window = self._combining.fitting(window, lost)
        self._combines(window, now)
        return window

    def _combines(self, window: list[Sent], now: float) -> None:
        """A combination of these packets leaves on a shared channel."""
        assert self._shared is not None
        self.peers.announced(self._shared.spanned(window))
        self._shared.combined(window, now)

    def _left_out(self, number: int, now: float) -> LeftOut:
        """What tells peers that they need not wait for a packet, nor for others around it."""
        told = self.packets.left_out(now, number)
        self.peers.announced(self.packets.told_of)
        if self._shared is not None:
            self._shared.tells(self.packets.told_of, now)
        return told

    def complete(self, record: Sent, now: float) -> Repair | None:
        """What brings a packet to the peers for which it was sent too fast."""
        record.skipped = 0
        for lifetime in record.lifetimes:
            lifetime.completes = True
        return self._bring(record, now)

    def _bring(self, record: Sent, now: float) -> Repair | None:
        """What brings a packet back that peers lack."""
        if self._shared is not None and len(self.peers.all) > 1 and not self.peers.replayed(record.number):
            return self._for_all(now, record.number)
        return self._alone(record, now)

    def _alone(self, record: Sent, now: float) -> Repair | None:
        record.at = now
        repair = self._combination([record], now)
        if repair is None and record.number + REACH < self.packets.newest:
            # It is waited for, and nothing that is alive, or will be, can bring it back above what the peer was told to
            # prove: the peer has taken an earlier proof. If it has not, what the packet holds is over in the end, or
            # its topic would stop for good.
            if self.packets.full(record.number):
                for lifetime in record.lifetimes:
                    lifetime.expires = -inf
                return None
            repair = self._combination([record], now, (0,))
        return repair

    def _combination(self, window: list[Sent], now: float, provens: Sequence[int] = ()) -> Repair | None:
        found = self._combining.combine(window, provens or self.peers.provens, now)
        self._no_place = found is None
        if found is None:
            return None
        repair, combined = found
        first = combined[-1].number
        if not self.peers.all:
            self._unreported.cover(combined, now)
        self._unreported.repaired()
        self.packets.told = max(self.packets.told, repair.number)
        if self.mode == "thrifty":
            self.thrift.combined(now, first, repair.number)
        self.peers.once.difference_update(range(first, repair.number + 1))
        return repair
