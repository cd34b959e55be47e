"""What leaves next, and what received packets change of that.

When the caller asks for a packet, it is, in this order: a hello that cannot wait; a question or an answer (``pings``);
a packet that a receiver lacks and for which later messages wait (``repair_slots``); new messages (``packing``); control
entries about other robots' packets (``report_slots``); a repair.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import inf

from gr_ros2.link.events import SentPacket
from gr_ros2.link.pace import Pace
from gr_ros2.link.rate import RateController
from gr_ros2.link.v1.audiences import Audiences
from gr_ros2.link.v1.endpoint_settings import Settings
from gr_ros2.link.v1.facts import (
    Appeared,
    Asked,
    Fact,
    Has,
    PeerLeft,
    PeerMet,
    ProofWanted,
    Questioned,
    Reached,
    Reported,
    Taken,
)
from gr_ros2.link.v1.hellos import Hellos
from gr_ros2.link.v1.hold import Hold
from gr_ros2.link.v1.neighbours import Neighbours
from gr_ros2.link.v1.outbox import Outbox
from gr_ros2.link.v1.pings import Pings
from gr_ros2.link.v1.relaying import Relaying
from gr_ros2.link.v1.repair import RepairWindow
from gr_ros2.link.v1.repair_slots import RepairSlots
from gr_ros2.link.v1.report_slots import LENGTH_LEN, ReportSlots
from gr_ros2.link.v1.reports import Reporter
from gr_ros2.link.v1.slowness import Slowness
from gr_ros2.link.v1.writer import PacketWriter, SendSlot
from gr_ros2.wire.control import (
    LEFT_OUT_LEN,
    NEWEST_LEN,
    Control,
    Heard,
    Hello,
    Newest,
    Report,
    length_of,
    write_control,
)
from gr_ros2.wire.v1 import BROADCAST, TABLE_TOPIC


class SendingSide:
    """The choice of what leaves next.

    :param pace: says when packets may leave
    :param rate: chooses the MCS of each packet; None for a fixed rate
    :param relaying: what is sent on of what others make; None where nothing is
    :ivar hellos: when this robot announces itself
    :ivar pings: its questions and answers
    :ivar repairs: its repairs
    :ivar reports: what it tells others of their packets
    :ivar urgent: whether a received packet may let one leave at once, before ``next_departure``
    """

    def __init__(
        self,
        settings: Settings,
        messages: Outbox,
        window: RepairWindow,
        neighbours: Neighbours,
        *,
        hellos: Hellos,
        writer: PacketWriter,
        hold: Hold,
        pace: Pace,
        rate: RateController | None = None,
        relaying: Relaying | None = None,
    ) -> None:
        self.settings, self._tuning = settings, settings.tuning
        self._telling_len = settings.tuning.gain_told * NEWEST_LEN + 1
        """Bytes in which a packet tells of messages of others, at least."""
        self._rate, self._relaying = rate, relaying
        self._pace = pace
        self._slowness = Slowness(pace)
        self.hellos = hellos
        self.pings = Pings(turn_s=settings.turn_s)
        self._audiences: Audiences | None = None
        if rate is not None and settings.dst_id == BROADCAST and not settings.shares and relaying is None:
            self._audiences = Audiences(
                rate,
                window.peers,
                window.packets,
                messages.sent,
                reads=neighbours.reads_left_out,
                room=writer.room,
                short=messages.packing.short,
                tuning=settings.tuning,
            )
        self.repairs = RepairSlots(settings, pace, window, writer=writer, hold=hold, audiences=self._audiences)
        self.reports = ReportSlots(settings, neighbours.all.values(), writer)
        self.urgent = False
        self._heard_at = inf
        """When any robot was heard last, or when this one began to send, s."""
        self._messages, self._window, self._neighbours = messages, window, neighbours
        self._writer = writer
        self._started = False
        self._hello_number = -1
        self._repeat_at = inf
        self._repeats = 1
        self._beacon_at = self._table_at = -inf

    def packet(self, slot: SendSlot) -> SentPacket | None:
        """The next packet, None if there is nothing to send."""
        now = slot.now
        if self.settings.beacon_s and self._alone(now):
            return self._beacon(slot)
        self.urgent = False
        if not self._started:
            self._start(now)
        messages, packing, hellos, reports = self._messages, self._messages.packing, self.hellos, self.reports
        if now >= hellos.due:
            idle = packing.next_timeout(now) > now
            if hellos.urgent(now, idle=idle, latency=packing.urgent, heard=bool(self._window.peers)):
                return self._hello(slot)
        elif self._unmet and packing.next_timeout(now) <= now:
            return self._hello(slot)  # whoever hears this packet first needs no other
        if now >= self.pings.due:
            snrs_db = {n.src_id: n.inbox.reports.snr.snr_db for n in self._neighbours.all.values()}
            return self._writer.control(self.pings.entries(self._writer.room, snrs_db, now), "hello", slot)
        if now >= self._repeat_at:
            self._repeat(now)
        if messages.sent.deadlines:
            messages.expire(now, self._pace.sure_interval(now))
        due = reports.due(now, last=packing.awaits_row)
        if reports.overdue and (told := reports.packet(due, slot)) is not None:
            return told
        if (repair := self.repairs.first(slot, packing)) is not None:
            return repair
        if self._relaying is not None:
            leaves = now if slot.leave_at is None else slot.leave_at
            self._relaying.sent_on.offer(messages.sent, now, leaves, self._writer.room - self._telling_len)
            self._relaying.custody.offer(now, leaves)
        if (sent := self._fill(due, slot)) is not None:
            return sent
        if now >= hellos.due:  # it let messages go first, and none of them is worth sending any more
            return self._hello(slot)
        if due:
            return reports.packet(due, slot)
        asks = reports.asks(slot) if now >= reports.requests.check_at else None
        return asks or self.repairs.spare(slot) or self._rows(slot) or reports.early(slot)

    def _rows(self, slot: SendSlot) -> SentPacket | None:
        """Rows of the table in a packet that nothing else needs."""
        wait = not self._messages.packing.fills or self.repairs.held(slot.now, repairs=False)
        return None if wait else self._fill([], slot, spare=True)

    def _fill(
        self, due: list[Reporter], slot: SendSlot, *, spare: bool = False, hello: Sequence[Control] = ()
    ) -> SentPacket | None:
        """A packet with messages.

        :param hello: goes along
        """
        now, reports, room = slot.now, self.reports, self._writer.room
        room -= sum(len(write_control(entry)) for entry in hello) + LENGTH_LEN * bool(hello)
        told: list[Newest] = []
        if self._relaying is not None:
            told = self._relaying.tells(now)
            room -= max(self._telling_len, sum(map(length_of, told)) + 1)  # an entry that fills it needs its length now
        number = self._window.packets.newest + 1
        parts = self._audiences is not None and self._parts()
        if parts:  # who waits for what was not sent to all is told
            room -= LEFT_OUT_LEN + LENGTH_LEN
        audiences = self._audiences
        filling = self._messages.packing.fill(number, room - reports.reserved, now, spare=spare, audiences=audiences)
        if filling is None:
            return None
        if self._relaying is not None:
            for message in filling.left:
                self._relaying.left(message, now)
        self.hellos.yielded()
        self._slowness.waited(filling.since, now)
        if due or now >= reports.requests.check_at:
            reports.add(filling.parts, room - filling.used, due, now)
        filling.parts += [*told, *hello]
        lifetimes = () if spare else filling.lifetimes
        if parts and filling.robots is None and any(lifetime.in_order for lifetime in lifetimes):
            filling.parts.append(self._window.packets.left_out(now))
        robots = filling.robots
        skipped = 0 if audiences is None else audiences.skipped(robots)
        sent = self._writer.source(
            filling.parts, lifetimes, filling.qos, filling.sent, slot, robots=robots, skipped=skipped
        )
        if audiences is not None:
            audiences.sent(robots, sent.mcs, now)
        return sent

    def _parts(self) -> bool:
        """Whether a message in order waits behind packets that were not sent to all."""
        return self._window.packets.parts and any(one.in_order and one.queue for one in self._messages.sent.values())

    def tells(self, now: float) -> list[Newest]:
        """What is told of messages of others."""
        return [] if self._relaying is None else self._relaying.tells(now)

    def behind(self, now: float) -> bool:
        """Whether messages that wait do so because the computer is too slow."""
        return self._slowness.behind(now) and not self._alone(now)

    @property
    def slow(self) -> bool:
        """Whether the computer was too slow lately, whatever waits now."""
        return self._slowness.slow

    def next_departure(self, now: float) -> float:
        """When ``packet`` may have something, s; without regard to credits."""
        if self._alone(now):
            return max(self._beacon_at, self._pace.slot)
        leaving = self._messages.packing.next_timeout(now)
        if leaving > now:
            leaving = min(leaving, self.hellos.due, self.pings.due, self._repeat_at, self.reports.next(now))
            leaving = min(leaving, self.reports.requests.next())
        if leaving > now:
            leaving = min(leaving, self.repairs.next(now, waiting=self._messages.packing.fills))
        return max(leaving, self._pace.slot)

    def learn(self, fact: Fact, now: float) -> None:
        """Something that matters here has arrived."""
        match fact:
            case Taken(trusted, urgent):
                if trusted:
                    self._heard_at = now
                    self.repairs.look_anew()
                if urgent:
                    self.urgent = True
                    self.reports.requests.told(now)
            case Reported(robot, number, report):
                self._reported(robot, number, report, now)
            case Has(robot, topic_id, order):
                self._window.peers.has(robot, topic_id, order, now)
            case Appeared(knows):
                self._appeared(now, knows=knows)
            case PeerMet(robot, proven, wanted):
                self._come(robot)
                self._window.peers.meet(robot, now)
                if proven is not None:
                    self._window.peers.prove(robot, proven, wanted=wanted)
                if self._rate is not None:
                    self._rate.meet(robot)
            case PeerLeft(robot, ended):
                self._left(robot, now, ended=ended)
            case Asked(robot, topic_ids):
                self._asked(robot, topic_ids, now)
            case Questioned(robot, entry):
                self.pings.receive(robot, self.settings.src_id, entry, now)
            case Reached(robot):
                self._messages.found(robot, now)
            case ProofWanted():
                self.hellos.answer(now)

    def _asked(self, robot: int, topic_ids: tuple[int, ...], now: float) -> None:
        for topic_id in topic_ids:
            if self._messages.kept.asked(topic_id, now, self._interval, robot=robot):
                self._messages.asks[topic_id] += 1
            else:
                self._neighbours.dropped["asked_too_often"] += 1

    def _come(self, robot: int) -> None:
        """A robot reports: if it has just come, it has missed what has left of the messages under way."""
        if robot not in self._window.peers.all:
            self._messages.kept.meet(robot)

    def _reported(self, robot: int, number: int, report: Report, now: float) -> None:
        loss = report.loss / 128
        not_for = 0.0
        if self._audiences is not None:
            not_for = self._audiences.not_for(robot, number)
            loss = max(loss - not_for, 0.0) / (1 - not_for)
        self._come(robot)
        self._window.peers.report(robot, number, report.arrived, settled=report.settled, loss=loss, now=now)
        self.repairs.reported()
        if self._relaying is not None:
            self._relaying.custody.reported(robot, now)
        if self._rate is not None and report.snr_db is not None:
            self._rate.report(robot, report.snr_db, report.loss / 128, now, not_for=not_for)

    def _left(self, robot: int, now: float, *, ended: bool) -> None:
        peers = self._window.peers
        if ended:
            peers.forget(robot)
        else:
            peers.leave(robot)
        if self._relaying is not None:
            self._relaying.custody.gone(robot)
        if not peers:
            self.hellos.hurry(now)
        if self._rate is not None:
            self._rate.forget(robot)

    def _appeared(self, now: float, *, knows: bool) -> None:
        """A robot is heard for the first time, or again: kept messages are repeated soon, and hellos sent.

        :param knows: it has heard this robot already
        """
        if self._repeats > 1:
            self._repeats = 1
            self._plan_repeat(now)
        if self.settings.hears:
            self.hellos.met(now, knows=knows)
        if self.settings.turns_are_rare and self._started:
            # It lacks the table, and would say so some turns later.
            self._messages.kept.asked(TABLE_TOPIC, now, self._interval, anew=True)

    @property
    def _interval(self) -> float:
        """s from one packet of this robot to the next, while it is busy; 0 = not known."""
        return max(self.settings.turn_s(), self._pace.interval)

    def reconfigure(self, settings: Settings, now: float) -> None:
        """Use other settings from now on."""
        before, self.settings = self.settings, settings
        if settings.repeat_s != before.repeat_s and self._started and self._messages.kept.digest:
            self._plan_repeat(now)
        if settings.packet_rate != before.packet_rate:
            self._pace.change(settings.packet_rate)

    def topics_changed(self, now: float) -> None:
        self.hellos.hurry(now)
        if self._started:
            self._messages.kept.tell(now)
            if self._repeat_at == inf:
                self._plan_repeat(now)

    def _alone(self, now: float) -> bool:
        """Whether nobody has been heard for so long that only beacons leave."""
        return 0 < self.settings.beacon_s <= now - self._heard_at

    def _beacon(self, slot: SendSlot) -> SentPacket | None:
        """What leaves while nobody is heard for long."""
        self._messages.expire(slot.now, self._pace.sure_interval(slot.now))
        if slot.now < self._beacon_at:
            return None
        self._beacon_at = slot.now + self.hellos.early(self.settings.beacon_s)
        return self._hello(slot)

    def _start(self, now: float) -> None:
        self._started = True
        self._heard_at = now
        self.hellos.start(now)
        if self._messages.kept.digest:
            self._messages.kept.ask(TABLE_TOPIC, now)
            self._plan_repeat(now)

    def _plan_repeat(self, now: float) -> None:
        every = self.settings.repeat_s * self._repeats
        self._repeat_at = now + self.hellos.early(every) if every else inf

    def _repeat(self, now: float) -> None:
        """Repeat the kept messages, if no robot reports that it has them."""
        self._repeats = min(2 * self._repeats, self._tuning.repeat_most) if self.hellos.lone else 1
        self._plan_repeat(now)
        if not self._window.peers:
            self._messages.kept.announce(now)

    @property
    def _joins(self) -> bool:
        """Whether hellos go along with messages: turns are rare, and no message in the clear would betray anything."""
        return self.settings.turns_are_rare and not self._writer.sealed and self._rate is None

    @property
    def _unmet(self) -> bool:
        """Whether a hello joins messages because somebody may hear them who has none."""
        return self._joins and not self.hellos.met_all

    def _hello(self, slot: SendSlot) -> SentPacket:
        now, window, kept, newest = slot.now, self._window, self._messages.kept, self._window.packets.newest
        again = newest == self._hello_number and not self.hellos.starting
        if again and not window.peers and self._writer.sealed:
            self._hello_number = -1
            # A receiver that restarts takes nothing below the number that it had stored.
            return self._writer.source([], (), 0, (), slot)
        self._hello_number = newest
        self.hellos.begin()
        starting = self.hellos.starting
        unmet = self._unmet
        often = starting or unmet or (now >= self._table_at and not self.hellos.lone)
        if often and (unmet or not window.peers) and kept.digest:  # no report says whether it has arrived
            self._table_at = now + kept.table_packets * self._pace.interval / self._tuning.table_share
            if unmet:
                kept.untold(now)
            else:
                kept.ask(TABLE_TOPIC, now, fills=not starting)
        entries = self.hellos.entries(self._writer.room, now)
        if self._joins and (joined := self._fill([], slot, hello=entries)) is not None:
            return joined
        sent = self._writer.control(entries, "hello", slot, clear=isinstance(entries[0], Hello))
        proving = [entry.src_id for entry in entries if isinstance(entry, Heard)]
        starts = frozenset((src_id, self._neighbours.all[src_id].boot) for src_id in proving)
        self._neighbours.own_hellos.said(sent.data, now, starts, slot.leave_at)
        for entry in entries:
            if isinstance(entry, Heard):
                since, wanted = self._neighbours.since(entry.src_id)
                window.peers.prove(entry.src_id, since, wanted=wanted)
        return sent
