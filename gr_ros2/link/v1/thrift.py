"""When a repair is worth its slot: more packets are missing, or expected to be missing, than repairs are on their way.

A peer that loses packets reports every packet at once if that takes no slot from anything. The sender then knows when a
report is overdue: the packet or its report was lost, and a repair is due. From other peers, whose reports are rare or
take long, it cannot know that so soon: it sends about as many repairs as losses are to be expected, before a report
names them.
"""

from __future__ import annotations

from collections import deque
from math import inf

from gr_ros2.core.tuning import Tuning
from gr_ros2.link.v1.peers import Peers
from gr_ros2.link.v1.sent_packets import Sent, SentPackets
from gr_ros2.wire.v1 import MAX_WINDOW


class Thrift:
    """The account of what is missing and what is on its way."""

    def __init__(self, packets: SentPackets, peers: Peers, tuning: Tuning) -> None:
        self._packets, self._peers, self._tuning = packets, peers, tuning
        self._flight: deque[tuple[float, int, int]] = deque()
        """When a repair left, and its window."""

    def combined(self, now: float, first: int, newest: int) -> None:
        """A combination of these numbers leaves."""
        self._flight.append((now, first, newest))
        for peer in self._peers.all.values():
            peer.asked = min(peer.asked, now)
            peer.repairs += 1

    def worth(self, window: list[Sent], now: float) -> bool:
        """Whether a combination of a window is worth its slot."""
        flight, peers = self._flight, self._peers.all.values()
        longest = max([peer.under_way(now) for peer in peers], default=inf)
        while flight and (flight[0][0] + longest <= now or flight[0][2] < self._packets.oldest):
            flight.popleft()
        first, last = window[-1].number, window[0].number
        enough, counts = self._tuning.repair_enough, self._tuning.repair_under_way
        under_way = [at for at, low, high in flight if low <= last and high >= first]
        if not peers:
            loss = self._peers.loss
            return len(window) * loss > len(under_way) * counts * (1 - loss) + enough
        for peer in peers:
            expected = 0.0 if peer.reports_soon else peer.loss
            (patience, told, calm), doubt = peer.overdue(), peer.doubt
            bit, lost, calm_is_over = peer.bit, peer.lost, now >= calm
            since = now - peer.under_way(now)
            coming = sum([at > since for at in under_way]) * counts * (1 - peer.loss) + enough
            need = 0.0
            for record in window:
                if not record.confirmed & bit:
                    if record.number in lost:
                        need += 1
                    elif now >= record.at + patience and (calm_is_over or record.at <= told):
                        need += doubt
                    else:
                        need += expected
                    if need > coming:
                        return True
        return False

    def next_doubt(self, since: float) -> float:
        """When a report about one of the newest packets, or about a repair, is overdue first after a time, s; inf if
        none is expected."""
        wait = min([peer.under_way(since) for peer in self._peers.all.values()], default=inf)
        soonest = next((at + wait for at, _, _ in self._flight if at + wait > since), inf)
        waits = [(peer.bit, peer.overdue()) for peer in self._peers.all.values()]
        for record in reversed(self._packets.records.values()):
            if record.number <= self._packets.newest - MAX_WINDOW:
                break
            for bit, (patience, told, calm) in waits:
                if not record.confirmed & bit:
                    doubt = record.at + patience
                    if doubt < calm and record.at > told:
                        doubt = calm
                    if since < doubt < soonest:
                        soonest = doubt
        return soonest
