"""Which packets carry reports: one of messages that has room for it, otherwise one of their own."""

from __future__ import annotations

from collections.abc import Iterable
from math import inf

from gr_ros2.link.events import SentPacket
from gr_ros2.link.v1.endpoint_settings import Settings
from gr_ros2.link.v1.neighbours import Neighbour
from gr_ros2.link.v1.reports import Reporter
from gr_ros2.link.v1.requests import ASK_LEN, Requests
from gr_ros2.link.v1.writer import PacketWriter, SendSlot
from gr_ros2.wire.control import MAP, REPORT_LEN
from gr_ros2.wire.v1 import EntryV1

LENGTH_LEN = 1
"""Bytes by which the last fragment of a packet grows when a report follows it: it cannot leave out its length then."""
MASK_LEN = MAP // 8
"""Bytes kept free there for the mask of a repair. Without it a repair of full packets names those too that are not
repaired any more, and who lacks one of these cannot use it. A mask of more packets than a report covers may not fit."""


class ReportSlots:
    """The reports that one robot sends about others.

    :ivar requests: what it asks others for
    :ivar reserved: bytes that messages leave free for the reports that are due, and for the mask of a repair
    """

    def __init__(self, settings: Settings, neighbours: Iterable[Neighbour], writer: PacketWriter) -> None:
        self.requests = Requests(neighbours, settings)
        self._neighbours = neighbours if settings.hears else ()
        self._writer = writer
        self._settings, self._tuning = settings, settings.tuning
        self._packet_len, self._shares = settings.packet_len, settings.shares
        self._allowed = float(self._tuning.shared_reports_first * REPORT_LEN * (settings.slower > 1))
        """Bytes of reports that may leave on a shared channel."""
        self._mask_len = MASK_LEN if settings.repair != "off" else 0
        self.reserved = self._mask_room = 0
        self._unheard = 0.0
        """New packets since a report became due and found no room, weighted."""
        self._unasked = 0
        """The same of a request."""

    def due(self, now: float, *, last: bool = False) -> list[Reporter]:
        """The reports that are due; on a shared channel as many as may leave, those first that miss something.

        :param last: they keep no room free
        """
        due = []
        for neighbour in self._neighbours:
            inbox = neighbour.inbox
            report = inbox.reports
            if (self._shares or report.unreported or inbox.order.held) and report.due(now) <= now:
                due.append(report)
        if self._shares:
            self._allowed = min(
                self._allowed + self._tuning.shared_reports * self._packet_len,
                self._tuning.shared_reports_at_once * REPORT_LEN,
            )
            long_ago = now - self._tuning.shared_report_waits_s * self._settings.slower
            due.sort(key=lambda r: (not r.lacks and r.reported_at > long_ago, r.reported_at))
            del due[int(self._allowed / REPORT_LEN) :]
            size = sum(report.size for report in due)
            self._allowed -= size
            room = size + (ASK_LEN + 1) * self.requests.crowded
            self._mask_room = min(self._mask_len, 1 + self._writer.newest // 8)  # of the longest window so far
            self.reserved = self._mask_room + (room + LENGTH_LEN * bool(room)) * (not last)
        return due

    @property
    def overdue(self) -> bool:
        """Whether a report that is due, or a request, has found no room for long."""
        return max(self._unheard, self._unasked) >= self._tuning.report_forced

    def next(self, now: float) -> float:
        """When a report may leave, s; inf for never."""
        soonest = inf
        for neighbour in self._neighbours:
            report = neighbour.inbox.reports
            soonest = min(soonest, now if report.unreported and report.helps else report.due(now))
        return soonest

    def add(self, entries: list[EntryV1], free: int, due: Iterable[Reporter], now: float) -> None:
        """Add reports and requests to the entries of a packet of messages, as far as they fit.

        :param free: bytes that they may take
        """
        free -= LENGTH_LEN * self._shares + self._mask_room
        for report in due:
            if free >= report.size:
                free -= report.size
                entries.append(report.make(now))
                self._unheard = 0
            else:
                self._unheard += self._weight(report.loss)
        entries += self.requests.entries(free, now)
        self._unasked = (self._unasked + 1) * self.requests.crowded

    def _weight(self, loss: float) -> float:
        """For how many new packets one counts, by the share of packets that is lost. With 1, two robots that always had
        full packets for each other brought 51 % of what they took at 30 % loss, and 7 % at 60 %; now 97 and 66 %."""
        return 1 / (1 - min(loss, self._tuning.shared_kept_up)) ** 3

    def packet(self, due: Iterable[Reporter], slot: SendSlot) -> SentPacket | None:
        """A packet with reports, and with requests where there is room; None if there are none."""
        entries: list[EntryV1] = []
        free = self._writer.room
        for report in due:
            if free >= report.size:
                free -= report.size
                entries.append(report.make(slot.now))
        entries += self.requests.entries(free, slot.now)
        self._unheard = self._unasked = 0
        return self._writer.control(entries, "report", slot) if entries else None

    def asks(self, slot: SendSlot) -> SentPacket | None:
        """A packet with requests, if there are any."""
        asks = self.requests.entries(self._writer.room, slot.now)
        return self._writer.control(asks, "hello", slot) if asks else None

    def early(self, slot: SendSlot) -> SentPacket | None:
        """A packet with reports that help though they are not due, if there are any."""
        early = [report for n in self._neighbours if (report := n.inbox.reports).helps]
        return self.packet(early, slot) if early else None
