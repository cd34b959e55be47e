"""What leaves next.

When the caller asks for a packet, it is, in this order: a hello that cannot wait; a question or an answer (``pings``);
a packet that a receiver lacks and for which later messages wait; new messages; control entries about other robots'
packets (reports and requests); a repair (``repair``). Reports are also added to a packet of messages that has room for
one.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import inf

from gr_ros2.link.events import SentPacket
from gr_ros2.link.pace import Pace
from gr_ros2.link.v1.endpoint_settings import Settings
from gr_ros2.link.v1.hellos import Hellos
from gr_ros2.link.v1.hold import Hold
from gr_ros2.link.v1.neighbours import Neighbour, Neighbours
from gr_ros2.link.v1.outbox import Filling, Outbox
from gr_ros2.link.v1.pings import Pings
from gr_ros2.link.v1.repair import RepairMode, RepairWindow
from gr_ros2.link.v1.requests import Requests
from gr_ros2.link.v1.writer import PacketWriter
from gr_ros2.settings.fields import AUTO
from gr_ros2.wire.control import Heard, Hello
from gr_ros2.wire.v1 import TABLE_TOPIC, EntryV1

MOST_REPEATS = 32
"""Most ``repeat_s`` from one repeat of the kept messages to the next, while nobody is heard though somebody could be:
the time doubles with each repeat, as in Trickle (RFC 6206). A robot that comes then asks for them."""
PATIENCE_S = 0.2
"""s for which a receiver waits in vain for a packet before it is told so in front of new messages."""
FORCED = 20
"""Number of new packets after which a report that found no room gets a packet of its own: 5 % of the slots."""
_POLL_S, _CALM_POLL_S = 0.02, 0.1
"""s after which a thrifty sender that is in doubt checks again; the second one while no receiver loses packets."""


class SendingSide:
    """The choice of what leaves next.

    :ivar pace: when packets may leave
    :ivar hellos: when this robot announces itself
    :ivar pings: its questions and answers
    :ivar urged: whether a received packet may let one leave at once, before ``next_departure``
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
    ) -> None:
        self.settings = settings
        self.pace = Pace(settings.packet_rate)
        self.hellos = hellos
        self.requests = Requests(neighbours, hears=settings.hears)
        self.pings = Pings()
        self.urged = False
        self._messages, self._window, self._neighbours = messages, window, neighbours
        self._writer, self._hold = writer, hold
        self._repair_at = -inf
        """Time in s up to which repairs wait, because a new message is about to come."""
        self._calm_since = inf
        """Time in s at which no repair was wanted, if no report has come since; otherwise infinite."""
        self._calm_number = 0
        """The newest packet then."""
        self._started = False
        self._hello_number = -1
        self._repeat_at = inf
        self._repeats = 1
        self.heard_at = inf
        """When any robot was heard last, or when this one began to send, s."""
        self._beacon_at = -inf
        self._unheard = 0
        """New packets since a report became due and found no room."""

    def packet(self, now: float) -> SentPacket | None:
        """The next packet, None if there is nothing to send."""
        if self._alone(now):
            return self._beacon(now)
        self.urged = False
        if not self._started:
            self._start(now)
        messages, hellos, window = self._messages, self.hellos, self._window
        if now >= hellos.due:
            waiting = messages.next_timeout(now)
            idle = waiting is None or waiting > now
            if hellos.urgent(now, idle=idle, latency=messages.urgent, heard=window.reported):
                return self._hello(now)
        if now >= self.pings.due:
            snrs_db = {n.src_id: n.inbox.reports.snr.snr_db for n in self._neighbours}
            return self._writer.control(self.pings.entries(self._writer.room, snrs_db, now), "hello", now)
        if now >= self._repeat_at:
            self._repeat(now)
        if messages.deadlines:
            messages.expire(now, self.pace.interval)
        due: Sequence[Neighbour] = ()
        if self.settings.hears:
            due = [n for n in self._neighbours if n.inbox.reports.due(now) <= now]
        if due and self._unheard >= FORCED:
            return self._report(due, now)
        if window.pressing and not messages.urgent and (first := self._first(now)) is not None:
            return first
        filling = messages.fill(window.newest + 1, self._writer.room, now)
        if filling is not None:
            return self._new(filling, due, now)
        if now >= hellos.due:  # it let messages go first, and none of them is worth sending any more
            return self._hello(now)
        if due:
            return self._report(due, now)
        return self._spare(now)

    def _spare(self, now: float) -> SentPacket | None:
        """What a slot carries in which no message, hello or due report leaves."""
        asks = self.requests.entries(self._writer.room, now)
        if asks:
            return self._writer.control(asks, "hello", now)
        window = self._window
        window.mode = self.mode
        over = window.over(now)
        repair = self._repair(now) if over < 0 else self._tell(over, now)
        if repair is not None:
            return repair
        early = [n for n in self._neighbours if n.inbox.reports.helps] if self.settings.hears else ()
        return self._report(early, now) if early else None

    def behind(self, now: float) -> bool:
        """Whether messages that wait do so because the computer is too slow."""
        return self.pace.behind(now) and not self._alone(now)

    def next_departure(self, now: float) -> float:
        """When ``packet`` may have something, s; without regard to credits."""
        if self._alone(now):
            return max(self._beacon_at, self.pace.slot)
        leaving = [self.hellos.due, self.pings.due, self._repeat_at]
        waiting = self._messages.next_timeout(now)
        if waiting is not None:
            leaving.append(waiting)
        if self.settings.hears:
            for neighbour in self._neighbours:
                reports = neighbour.inbox.reports
                leaving.append(min(now, reports.due(now)) if reports.helps else reports.due(now))
        if min(leaving) > now and self.mode != "off" and self._window.unconfirmed(now):
            leaving.append(max(self._repair_at, now if self.mode == "idle" else self._next_look(now)))
        return max(min(leaving), self.pace.slot)

    @property
    def mode(self) -> RepairMode:
        """What idle slots carry."""
        mode = self.settings.repair
        if not self.pace.known:  # nothing limits how many packets leave: repair only what reports call for
            return "thrifty" if mode != "off" and self._window.reported else "off"
        if mode != AUTO:
            return mode
        return "thrifty" if self._window.reported else "idle"

    def received(self) -> None:
        """Something has been received: what waits to be repaired is looked at again."""
        self._repair_at = -inf

    def reported(self) -> None:
        """A report has come."""
        self._calm_since = inf

    def met(self, now: float) -> None:
        """A robot is heard for the first time, or again: kept messages are repeated soon, and hellos sent."""
        if self._repeats > 1:
            self._repeats, self._repeat_at = 1, now + self.settings.repeat_s
        if self.settings.hears:
            self.hellos.met(now)

    def topics_changed(self, now: float, *, added: bool, asked: bool) -> None:
        """See :class:`gr_ros2.link.v1.outbox.Owner`."""
        self.hellos.hurry(now)
        if added and self._started and self._repeat_at == inf and self.settings.repeat_s:
            self._repeat_at = now + self.settings.repeat_s
        if asked and self._started:
            self._messages.ask(TABLE_TOPIC, now)

    def _alone(self, now: float) -> bool:
        """Whether nobody has been heard for so long that only beacons leave."""
        return 0 < self.settings.beacon_s <= now - self.heard_at

    def _beacon(self, now: float) -> SentPacket | None:
        """What leaves while nobody is heard for long."""
        self._messages.expire(now, self.pace.interval)
        if now < self._beacon_at:
            return None
        self._beacon_at = now + self.settings.beacon_s
        return self._hello(now)

    def _start(self, now: float) -> None:
        self._started = True
        self.heard_at = now
        self.hellos.start(now)
        if self._messages.digest:
            self._messages.ask(TABLE_TOPIC, now)
            if self.settings.repeat_s:
                self._repeat_at = now + self.settings.repeat_s

    def _repeat(self, now: float) -> None:
        """Repeat the kept messages, if no robot reports that it has them."""
        self._repeats = min(2 * self._repeats, MOST_REPEATS) if self.hellos.lone else 1
        self._repeat_at = now + self.settings.repeat_s * self._repeats
        if not self._window.reported:
            self._messages.announce(now)

    def _new(self, filling: Filling, due: Sequence[Neighbour], now: float) -> SentPacket:
        """A source packet, with a report where there is room for one."""
        self.pace.waited(filling.since, now)
        entries = filling.parts
        free = self._writer.room - filling.used
        for neighbour in due:
            reports = neighbour.inbox.reports
            if free >= reports.size:
                free -= reports.size
                entries.append(reports.make(now))
                self._unheard = 0
            else:
                self._unheard += 1
        return self._writer.source(entries, filling.lifetimes, filling.qos, filling.sent, now)

    def _report(self, due: Sequence[Neighbour], now: float) -> SentPacket:
        """A packet with reports, and with requests where there is room."""
        entries: list[EntryV1] = []
        free = self._writer.room
        for neighbour in due:
            reports = neighbour.inbox.reports
            if free >= reports.size:
                free -= reports.size
                entries.append(reports.make(now))
        entries += self.requests.entries(free, now)
        self._unheard = 0
        return self._writer.control(entries, "report", now)

    def _first(self, now: float) -> SentPacket | None:
        """What goes before new messages: what a receiver lacks or waits for in vain, so that later messages wait."""
        self._window.mode = self.mode
        again = self._window.urgent(now)
        if again is not None:
            return self._writer.repair(again, now)
        over = self._window.over(now, PATIENCE_S)
        return self._tell(over, now) if over >= 0 else None

    def _tell(self, number: int, now: float) -> SentPacket | None:
        """Say that a packet is not repaired any more."""
        repair = self._window.tell(number, now)
        if repair is not None:
            return self._writer.repair(repair, now)
        return None if self._window.unconfirmed(now) else self._writer.control([], "repair", now)

    def _repair(self, now: float) -> SentPacket | None:
        self._repair_at = -inf
        chosen = self._window.next(now, self._held)
        held = self._repair_at > now
        self._calm_since = now if chosen is None and not held else inf
        self._calm_number = self._window.newest
        if chosen is not None:
            self._hold.repaired(waiting=held)
            return self._writer.repair(chosen, now)
        lifetimes = () if held else self._window.exhausted(now)
        return self._writer.source([], lifetimes, 0, (), now) if lifetimes else None

    def _next_look(self, now: float) -> float:
        """When a thrifty sender may want to repair something."""
        window = self._window
        if not window.loss:
            return min(now + _CALM_POLL_S, window.next_doubt(now))
        if self._calm_since == inf or window.newest != self._calm_number:
            return now
        return min(now + _POLL_S, window.next_doubt(self._calm_since))

    def _held(self, now: float) -> bool:
        """Whether a repair that could leave now waits for a new message."""
        airtime = self.pace.interval
        self._repair_at = self._hold.until(now, self.pace.free(now) + airtime, airtime)
        return self._repair_at > now

    def _hello(self, now: float) -> SentPacket:
        window, messages = self._window, self._messages
        if window.newest == self._hello_number and not window.reported and self._writer.sealed:
            self._hello_number = -1
            # A receiver that restarts takes nothing below the number that it had stored.
            return self._writer.source([], (), 0, (), now)
        self._hello_number = window.newest
        if self.hellos.starting and not window.reported:
            messages.ask(TABLE_TOPIC, now)  # no report says whether it has arrived
        entries = self.hellos.entries(self._writer.room, now)
        sent = self._writer.control(entries, "hello", now, clear=isinstance(entries[0], Hello))
        self._neighbours.said_hello(sent.data, now)
        for entry in entries:
            if isinstance(entry, Heard):
                window.proven(entry.src_id, self._neighbours.since(entry.src_id))
        return sent
