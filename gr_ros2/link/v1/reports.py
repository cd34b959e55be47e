"""When one robot's packets are reported to it, and what a report says.

A report is due after some packets, or some time after the first of them; after a loss at once. It becomes rarer while
nothing is lost, because it costs both ends as much as a message, and reports before their time take no more than a
share of the packets. While messages wait for an earlier one, reports go on: the last one may be lost, and with it that
they wait.

*Where many share a channel* (:class:`SharedReporter`), reports about all by all would fill it: among 20 robots with
10 Hz of odometry they took half of the bytes sent. Then packets are reported only if something in them may be repaired:
topics without reliable publishers need no reports, since the next message is the repair, and who repairs nothing needs
none at all. Who misses something reports after each packet of the sender, before those who only confirm.

Invariant: a report tells state, not events, so a lost report costs nothing but time.
"""

from __future__ import annotations

from math import inf

from gr_ros2.link.v1.decoder import RepairDecoder
from gr_ros2.link.v1.endpoint_settings import Settings
from gr_ros2.link.v1.order import Order
from gr_ros2.link.v1.reassembly import Reassembly
from gr_ros2.link.v1.snr import SnrFilter
from gr_ros2.wire.control import MAP, REPORT_LEN, Report, reportable


class Reporter:
    """The reports about one start of one robot.

    :param sender: id and boot number of the robot
    :param decoder: knows which packets are here
    :param order: knows which packets are waited for
    :param settings: of this robot
    :ivar unreported: packets since the last report
    :ivar loss: recent share of lost packets
    :ivar confirms: whether something has arrived that the sender repairs until it is confirmed
    :ivar snr: SNR of its packets
    :param tells_snr: whether reports give the SNR, as an adaptive rate needs
    """

    def __init__(
        self,
        sender: tuple[int, int],
        decoder: RepairDecoder,
        order: Order,
        settings: Settings,
        *,
        tells_snr: bool = True,
    ) -> None:
        self._tuning = settings.tuning
        self.unreported = 0
        self.loss = 0.0
        self.confirms = False
        self.snr = SnrFilter(settings.tuning)
        self.tells_snr = tells_snr
        self._sender = sender
        self._decoder, self._order = decoder, order
        self._settings = settings
        self._rare = settings.half_duplex or settings.shares or settings.airtime_share < 1
        """Whether reports take airtime from others, or from what this robot may send."""
        self._arrived = 0
        """Source packets that have arrived."""
        self._unspent = 1.0
        """Reports before their time that may leave."""
        self._missed = False
        """Whether a packet went missing since the last report."""
        self.reported_at = 0.0
        self._pause_s = self._after(self._tuning.report_pause_s)
        """s after which a report is due, where nobody else shares the channel: it does not change there."""
        self._every = self._tuning.report_every * (4 if self._rare else 1)
        self._most: float = self._every
        """Packets after which a report is due now; more than ``_every`` where nothing is lost."""
        self._slowly = 1.0
        """By how much longer than ``report_pause_s`` the next report is put off, because nothing is lost."""
        self._made = 0
        """Reports so far."""

    def arrived(self, *, late: bool) -> None:
        """Note a source packet.

        :param late: a later one was here before
        """
        self.unreported += 1
        self._arrived += 1
        if self._unspent < self._tuning.report_most_saved:
            self._unspent = min(self._unspent + 1 / self._tuning.report_per_arrived, self._tuning.report_most_saved)
        if not late:
            self.loss -= self.loss * self._tuning.report_smoothing

    def repair(self, *, new: bool) -> None:
        """Note a repair, or word that something is not repaired any more.

        :param new: it was not here before
        """
        self.unreported += new
        self.confirm()

    def confirm(self) -> None:
        """Note that something has come that its sender repairs until it is confirmed."""
        self.confirms = True

    def repaired_in_vain(self) -> None:
        """Note a repair of what is here: its sender repairs on until it is told, which costs more than a report."""
        self._unspent = min(self._unspent + self._tuning.report_per_vain, self._tuning.report_most_saved)

    def missed(self, packets: int, *, counts: bool) -> None:
        """Note packets that have not arrived.

        :param counts: whether they were lost; otherwise nobody listened
        """
        self._missed = True
        allowed = self._tuning.report_per_loss * min(packets, 1000)
        self._unspent = min(self._unspent + allowed, self._tuning.report_most_saved)
        if counts:
            self.loss = 1 - (1 - self.loss) * (1 - self._tuning.report_smoothing) ** min(packets, 1000)

    def due(self, now: float) -> float:
        """When the next report is due, s; infinite if there is nothing to report."""
        if not self.unreported:
            waits = self._order.held and self._order.told
            return self.reported_at + max(self._tuning.report_again_s, self._pause_s) if waits else inf
        at_once = (self._missed or (self.tells_snr and self.snr.changed)) and not self._rare and self._unspent >= 1
        if at_once or self.unreported >= self._most:
            return now
        return self.reported_at + self._pause_s * self._slowly

    def _after(self, seconds: float) -> float:
        """s that are as many packets of others on a slow channel."""
        return seconds * self._settings.slower

    @property
    def lacks(self) -> bool:
        """Whether something is known to be missing."""
        return self._missed

    @property
    def helps(self) -> bool:
        """Whether to send a report early, in a slot that nothing else needs, so that losses are noticed sooner."""
        free = self._unspent >= 1 and not self._rare
        return free and self.unreported > 0 and self.loss >= self._tuning.report_prompt_loss

    @property
    def size(self) -> int:
        """Bytes of a report."""
        return REPORT_LEN + (self.tells_snr and self.snr.snr_db is not None)

    def make(self, now: float) -> Report:
        """What has arrived: in the newest part and, in turn, in the oldest part with missing packets."""
        tuning = self._tuning
        calm = not self._missed and self.loss < tuning.report_calm_loss and self._arrived > MAP
        slowest = max(tuning.report_calm_s / self._pause_s, 1.0)
        self._slowly = min(self._slowly * tuning.report_slower, slowest) if calm else 1.0
        self._most = min(self._every * self._slowly, max(self._every, MAP // 2))
        self.unreported = 0
        self._missed = False
        self._unspent = max(self._unspent - 1, 0.0)
        self.reported_at = now
        decoder, wanted = self._decoder, self._order.wanted
        newest = decoder.newest
        base = newest
        if self._made % tuning.report_oldest == 0 and wanted < newest - MAP + 1:
            base = wanted + MAP - 1
        self._made += 1
        arrived, here = 0, decoder.bodies
        for back in range(MAP):
            number = base - back
            if number in here or number < wanted:
                arrived |= 1 << back
        settled = wanted > base - MAP
        loss = min(round(self.loss * 128), 127)
        snr = self.snr
        snr_db = snr.reported_db = reportable(snr.snr_db) if self.tells_snr and snr.snr_db is not None else None
        src_id, boot = self._sender
        return Report(src_id, boot & 0xFFFF, max(base, 0) & 0xFFFF, arrived, settled, loss, snr_db)


class SharedReporter(Reporter):
    """The same on a channel that many share, see the module.

    :param reassembly: knows which messages are incomplete
    """

    def __init__(
        self,
        sender: tuple[int, int],
        decoder: RepairDecoder,
        order: Order,
        settings: Settings,
        reassembly: Reassembly,
        *,
        tells_snr: bool = True,
    ) -> None:
        super().__init__(sender, decoder, order, settings, tells_snr=tells_snr)
        self._reassembly = reassembly

    @property
    def lacks(self) -> bool:
        """Whether something is known to be missing."""
        decoder, order = self._decoder, self._order
        return order.held > 0 or decoder.lacks(order.wanted) or self._reassembly.lacks(decoder)

    def due(self, now: float) -> float:
        if self._order.told and self.lacks:
            return now if self.unreported else self.reported_at + self._after(self._tuning.report_confirm_s)
        wanted = (self._order.told and self.confirms) or (self.tells_snr and self.snr.changed)
        return self.reported_at + self._after(self._tuning.report_confirm_s) if wanted and self.unreported else inf

    def make(self, now: float) -> Report:
        self.confirms = False
        return super().make(now)
