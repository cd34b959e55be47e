"""Repairs on a channel that many share.

A robot's turn comes seldom there, and something new always waits. So no slot is idle, and repairs of messages in order
go before new messages, no more in a row than losses call for. As soon as such a message has left, a combination of it
follows where losses are to be expected. Each further one that reports call for brings back one packet to every peer,
whichever that lacks. Packets of which the next message is the repair are left out: who lost one could use no
combination with it.
"""

from __future__ import annotations

from collections.abc import Iterable
from math import ceil, inf

from gr_ros2.core.tuning import Tuning
from gr_ros2.link.v1.lifetime import Lifetime
from gr_ros2.link.v1.sent_packets import Sent, SentPackets
from gr_ros2.wire.v1 import MAX_WINDOW


def in_a_row(loss: float, kept_up: float) -> int:
    """Repairs that may go before a new packet: where more than half is lost and something new always waits, with one
    nothing in order would come out any more.

    :param loss: share of packets that the peer with the most losses loses
    :param kept_up: loss up to which repairs keep up
    """
    return ceil(loss / (1 - loss)) if 0.5 < loss <= kept_up else 1


class SharedRepairs:
    """What one sender on a shared channel knows of its repairs.

    :param packets: what has left and may be repaired
    """

    def __init__(self, packets: SentPackets, tuning: Tuning) -> None:
        self._packets, self._tuning = packets, tuning
        self._ordered = -1
        """The newest packet with a part of a message in order."""
        self._begun = 0
        """Packets in a row with messages in order of which none ended."""
        self._going_on: list[Lifetime] = []
        """Messages in order that go on."""
        self._may = 0
        """Repairs that may leave before the next new packet."""
        self._told_at = -inf
        self._told = range(0)
        """The numbers of which the newest combination says what is not repaired any more, and when it left, s."""
        self._owed = 0.0

    def sent(self, number: int, lifetimes: tuple[Lifetime, ...], loss: float) -> None:
        """A source packet leaves.

        :param loss: share of packets that the peer with the most losses loses
        """
        self._may = in_a_row(loss, self._tuning.shared_kept_up)
        ordered = [lifetime for lifetime in lifetimes if lifetime.in_order]
        if ordered:
            self._ordered = number
            self._begun = 0 if any(lifetime.left for lifetime in ordered) else self._begun + 1
            self._going_on = [lifetime for lifetime in ordered if not lifetime.left]
            loss = min(loss, self._tuning.shared_kept_up)
            self._owed += loss / (1 - loss)

    @property
    def within(self) -> bool:
        """Whether messages in order go on in later packets, none has just ended, and repairs wait for that."""
        waits = 0 < self._begun < self._tuning.shared_within and self._owed < self._tuning.shared_most_owed
        return waits and any(lifetime.expires > -inf for lifetime in self._going_on)

    @property
    def due(self) -> bool:
        """Whether a repair is due that no report has called for."""
        return self._owed >= self._tuning.shared_owed

    def may_leave(self, *, idle: bool) -> bool:
        """Whether a repair may leave now.

        :param idle: nothing new waits
        """
        return not self.within and (self._may > 0 or idle)

    def combined(self, window: list[Sent], now: float) -> None:
        """A combination of these packets leaves."""
        self._owed = max(self._owed - 1, 0.0)
        self.tells(self.spanned(window), now)
        for record in window:
            record.at = now

    def tells(self, numbers: range, now: float) -> None:
        """A packet leaves that says what of these numbers is not repaired any more."""
        self._may -= self._may > 0
        self._told, self._told_at = numbers, now

    def window(self, now: float, lost: int) -> list[Sent]:
        """All that is worth a combination up to the newest packet in order, newest first; what is around a packet that
        is older.

        :param lost: that packet; -1 for none
        """
        packets = self._packets
        packets.retire(now)
        window: list[Sent] = []
        ordered = self._ordered if lost < 0 else min(self._ordered, max(lost, packets.oldest) + MAX_WINDOW // 2)
        for newest in (ordered, packets.newest):  # where all in order is confirmed, it says at least that
            first = max(packets.oldest, newest - MAX_WINDOW + 1)
            window = window or [record for record in packets.live(first, newest, now)[::-1] if record.lasts(now)]
        return window

    def spanned(self, window: list[Sent]) -> range:
        """The numbers of which a combination of these packets tells whether they are repaired: all older ones, too, if
        the oldest is in it."""
        packets = self._packets
        if not window:
            return range(packets.newest + 1)
        first = window[-1].number
        return range(0 if first == packets.oldest else first, window[0].number + 1)

    def waits(self, number: int, now: float, period: float) -> bool:
        """Whether peers may wait in vain for a packet that is not repaired: only messages in order wait, and only for
        what they were not told of.

        :param period: mean time between two new packets, s
        """
        told = number in self._told and now < self._told_at + self._tuning.shared_told_times * period
        return not self.within and number < self._ordered and not told


def newest_of(window: Iterable[Sent], lost: set[int]) -> int | None:
    """The newest packet of a window that a peer lacks."""
    return max((record.number for record in window if record.number in lost), default=None)
