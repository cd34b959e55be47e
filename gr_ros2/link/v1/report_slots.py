"""Which packets carry reports: one of messages that has room for it, otherwise one of their own."""

from __future__ import annotations

from collections.abc import Iterable
from math import inf

from gr_ros2.link.events import SentPacket
from gr_ros2.link.v1.neighbours import Neighbour
from gr_ros2.link.v1.reports import Reporter
from gr_ros2.link.v1.requests import Requests
from gr_ros2.link.v1.writer import PacketWriter
from gr_ros2.wire.v1 import EntryV1

FORCED = 20
"""Number of new packets after which a report that found no room gets a packet of its own: 5 % of the slots."""


class ReportSlots:
    """The reports that one robot sends about others.

    :param hears: whether it hears any
    :ivar requests: what it asks others for
    """

    def __init__(self, neighbours: Iterable[Neighbour], writer: PacketWriter, *, hears: bool) -> None:
        self.requests = Requests(neighbours, hears=hears)
        self._neighbours = neighbours if hears else ()
        self._writer = writer
        self._unheard = 0
        """New packets since a report became due and found no room."""

    def due(self, now: float) -> list[Reporter]:
        """The reports that are due."""
        return [report for n in self._neighbours if (report := n.inbox.reports).due(now) <= now]

    @property
    def overdue(self) -> bool:
        """Whether a report that is due has found no room for long."""
        return self._unheard >= FORCED

    def next(self, now: float) -> float:
        """When a report may leave, s; inf for never."""
        reports = [neighbour.inbox.reports for neighbour in self._neighbours]
        return min([min(now, report.due(now)) if report.helps else report.due(now) for report in reports], default=inf)

    def add(self, entries: list[EntryV1], free: int, due: Iterable[Reporter], now: float) -> None:
        """Add reports to the entries of a packet of messages, as far as they fit.

        :param free: bytes that they may take
        """
        for report in due:
            if free >= report.size:
                free -= report.size
                entries.append(report.make(now))
                self._unheard = 0
            else:
                self._unheard += 1

    def packet(self, due: Iterable[Reporter], now: float) -> SentPacket:
        """A packet with reports, and with requests where there is room."""
        entries: list[EntryV1] = []
        free = self._writer.room
        for report in due:
            if free >= report.size:
                free -= report.size
                entries.append(report.make(now))
        entries += self.requests.entries(free, now)
        self._unheard = 0
        return self._writer.control(entries, "report", now)

    def asks(self, now: float) -> SentPacket | None:
        """A packet with requests, if there are any."""
        asks = self.requests.entries(self._writer.room, now)
        return self._writer.control(asks, "hello", now) if asks else None

    def early(self, now: float) -> SentPacket | None:
        """A packet with reports that help though they are not due, if there are any."""
        early = [report for n in self._neighbours if (report := n.inbox.reports).helps]
        return self.packet(early, now) if early else None
