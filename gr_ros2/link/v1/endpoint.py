"""One robot's end of a link that speaks version 1: messages in, packets out; packets in, messages out.

*Order of sending.* When the caller asks for a packet, the endpoint chooses in this order: a hello that cannot wait, new
messages, control entries about other robots' packets (reports and requests), repair (``link.repair``). Reports are also
added to a packet of messages that has room for one.

Invariants: every submitted message is accepted once; it then leaves whole or is refused with a named reason;
``receive`` never raises, whatever the bytes; packets leave only when the pace (rate or credit) allows; each number is
sent once, and each row once per number; there is no clock, no randomness and no IO here: the caller passes in the time,
the boot number and the stored state.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from math import inf
from typing import Any

from gr_ros2.core.errors import ConfigError, EntryKindError, NoKeyError, NotSealedError, WireError
from gr_ros2.link.endpoint import check_live
from gr_ros2.link.events import (
    AirKind,
    Delivered,
    Gone,
    Lost,
    Met,
    Missed,
    Received,
    ReceiverEvent,
    Rejected,
    SenderEvent,
    SentEntry,
    SentPacket,
)
from gr_ros2.link.ledger_rows import LedgerRow
from gr_ros2.link.message_codec import MessageCodec
from gr_ros2.link.pace import Pace
from gr_ros2.link.rate import RateController, Rung
from gr_ros2.link.stats import ReceiverStats
from gr_ros2.link.v1.endpoint_settings import NOBODY, Settings
from gr_ros2.link.v1.hold import Hold
from gr_ros2.link.v1.inbox import Inbox
from gr_ros2.link.v1.neighbours import Neighbour, Neighbours, Opened, Save
from gr_ros2.link.v1.outbox import Filling, Outbox
from gr_ros2.link.v1.repair import Life, Repair, RepairMode, RepairWindow, Sent
from gr_ros2.link.v1.sealing import SOURCE_ROW, Checksum, Keys
from gr_ros2.link.v1.talk import Talk
from gr_ros2.settings.config import QueuePolicy
from gr_ros2.settings.fields import AUTO
from gr_ros2.settings.registry import NewRow, Registry
from gr_ros2.wire.control import (
    CAN_HEAR,
    ECHO_LEN,
    REPORTED,
    WANTS_PROOF,
    Ask,
    Control,
    Heard,
    Hello,
    Report,
)
from gr_ros2.wire.table import Row as TableRow
from gr_ros2.wire.v1 import (
    BROADCAST,
    QOS_STANDING,
    TABLE_TOPIC,
    Entry,
    Header,
    Packet,
    Standing,
    body_room,
    read_body,
    read_header,
    write_body,
    write_header,
    write_standing,
)

GIVE_UP_S = 10.0
"""s of silence after which a robot is regarded as gone."""
HOP = 1
"""Hop count of addressed packets: nothing relays them yet."""
MOST_REPEATS = 32
"""Most ``repeat_s`` from one repeat of the kept messages to the next, while nobody is heard though somebody could be:
the time doubles with each repeat, as in Trickle (RFC 6206). A robot that comes then asks for them."""
PATIENCE_S = 0.2
"""s for which a receiver waits in vain for a packet before it is told so in front of new messages."""
FORCED = 20
"""Number of new packets after which a report that found no room gets a packet of its own: 5 % of the slots."""
_POLL_S, _CALM_POLL_S = 0.02, 0.1
"""s after which a thrifty sender that is in doubt checks again; the second one while no receiver loses packets."""


class Endpoint:
    """Both directions of one robot.

    :param topics: topics that it sends; None if it only receives
    :param boot: number of this start; it is greater than all earlier ones
    :param keys: keys that seal its packets
    :param codec: codes the messages sent
    :param decoder_for: makes the decoder for a robot's messages from its table of topics
    :param rows: topics of robots that announce none
    :param heard: what ``save`` stored before this start
    :param save: stores up to which packet a robot was heard; needed if ``keys`` must keep replays out after a restart
    :param observer: called with every SenderEvent, in order
    :param ladder: the rungs of an adaptive rate, see :mod:`gr_ros2.link.rate`; () for a fixed rate
    :ivar rung: rung of the last packet, 0 with a fixed rate
    """

    def __init__(
        self,
        topics: Registry | None,
        settings: Settings,
        *,
        boot: int,
        keys: Keys | None = None,
        codec: MessageCodec | None = None,
        decoder_for: Callable[[tuple[TableRow, ...]], MessageCodec] | None = None,
        rows: tuple[TableRow, ...] = (),
        heard: Mapping[int, tuple[int, int]] | None = None,
        save: Save | None = None,
        observer: Callable[[SenderEvent], None] | None = None,
        ladder: Sequence[Rung] = (),
    ) -> None:
        self.settings = settings
        self.rung = 0
        self.ladder = tuple(ladder)
        self._rate = RateController(ladder) if ladder else None
        self.boot = boot
        self.keys = keys if keys is not None else Keys()
        self.received = ReceiverStats()
        """What arrived and what did not."""
        self.answers = bool(topics) or settings.hears
        """Whether what it receives can change what it sends."""
        self.urged = False
        """Whether a received packet may let one leave at once, before ``next_departure``."""
        self._observer = observer
        self._decoder_for = decoder_for
        self._rows = rows
        self._marks: dict[int, dict[int, tuple[int, ...]]] = {}
        """CRC-32 of the latched messages of every robot; kept when the robot restarts."""
        self._sealed, self._encrypts = self.keys.sealed, self.keys.encrypts
        addressed = settings.dst_id != BROADCAST
        self._room = body_room(settings.packet_len, sealed=self._sealed, addressed=addressed)
        self._end_of_body = settings.packet_len - self.keys.trailer_len if settings.fixed else 0
        """Number of bytes to which the packet with its padded body extends."""
        # An end without an id only listens and closes no packet. Its id makes no key.
        self._trailer = Checksum(boot) if settings.src_id == NOBODY else self.keys.own(settings.src_id, boot)
        self.outbox = Outbox(topics, settings, boot=boot, room=self._room, codec=codec, observer=observer)
        self.sent = self.outbox.stats
        """What left and what did not."""
        self.window = RepairWindow(
            "idle" if settings.repair == AUTO else settings.repair, self._room, settings.expected_loss
        )
        self.neighbours = Neighbours(
            (settings.src_id, boot),
            settings,
            self.keys,
            heard=heard or {},
            save=save,
            inbox=self._inbox,
            dropped=self.received.dropped,
        )
        self.topics = topics
        """What it sends."""
        self._codec = codec
        self._events: list[ReceiverEvent] = []
        self._now = -inf
        self._pace = Pace(settings.packet_rate)
        self._hold = Hold()
        self._repair_at = -inf
        """Time in s up to which repairs wait, because a new message is about to come."""
        self._calm_since = inf
        """Time in s at which no repair was wanted, if only the time has changed since; otherwise infinite."""
        self._talk = Talk(settings, boot, encrypts=self.keys.encrypts)
        self._started = False
        self._hello_number = -1
        self._repeat_at = inf
        self._repeats = 1
        self._unheard = 0
        """New packets since a report became due and found no room."""
        self._sender: Neighbour | None = None

    # ---- sending

    @property
    def idle(self) -> bool:
        """Whether no message waits, and no packet that has left is worth repairing."""
        mending = self._mode() != "off" and self.window.unconfirmed(self._now)
        return self.outbox.idle and not mending

    def submit(self, topic_id: int, payload: bytes, now: float, lifespan_s: float = inf) -> None:
        """Take a serialized message.

        :param lifespan_s: s after which this message is useless, on a topic whose queue has a deadline
        """
        if not self.outbox.sends(topic_id):
            raise ConfigError(f"topic id {topic_id} is not among the {len(self.topics or ())} topics that are sent")
        self._now = max(self._now, now)
        self._hold.submitted(topic_id, now)
        self.outbox.submit(topic_id, payload, now, lifespan_s)

    def offer(self, topic_id: int, *, offered: bool) -> None:
        """Start or stop announcing a service to the other robots. At the start, services are not announced."""
        if self.outbox.offer(topic_id, offered=offered) and self._started:
            self.outbox.ask(TABLE_TOPIC, self._now)
            self._talk.hurry(self._now)

    def add(self, rows: Sequence[NewRow]) -> Registry:
        """See :class:`gr_ros2.link.endpoint.Endpoint`. The robots that hear this one learn of them from the next
        hello."""
        together = (Registry.empty() if self.topics is None else self.topics).extended(rows)
        topics = together[-len(rows) :] if rows else ()
        if self._codec is not None:
            for topic in topics:
                self._codec.add(topic)
        self.topics = together
        self.answers = True
        self.outbox.add(topics)
        self._talk.hurry(self._now)
        if self._started and self._repeat_at == inf and self.settings.repeat_s:
            self._repeat_at = self._now + self.settings.repeat_s
        return together

    def forget_kept(self, topic_id: int) -> None:
        """See :class:`gr_ros2.link.endpoint.Endpoint`."""
        self.outbox.forget_kept(topic_id)

    def learn(self, type_name: str, definitions: Mapping[str, Any]) -> None:
        """See :class:`gr_ros2.link.endpoint.Endpoint`. The robots that hear this one are told."""
        if self._codec is None:
            return
        self._codec.learn(type_name, definitions)
        if self.outbox.recoded() and self._started:
            self.outbox.ask(TABLE_TOPIC, self._now)
            self._talk.hurry(self._now)

    def missed(self, topic_id: int, total: int) -> None:
        """Count how many messages of a topic the ROS graph has lost so far, before they could be submitted."""
        new = total - self.sent.missed[topic_id]
        if new > 0:
            self.sent.missed[topic_id] = total
            if self._observer is not None:
                self._observer(Missed(topic_id, new))

    def queue(self, topic_id: int) -> tuple[QueuePolicy, float]:
        """Policy and deadline (s, 0 for none) of a topic's queue."""
        return self.outbox.queue(topic_id)

    def depth(self, topic_id: int) -> int:
        """Number of messages of a topic that may wait, 0 for unbounded."""
        return self.outbox.depth(topic_id)

    def room(self, topic_id: int) -> bool:
        """Whether a message of that topic could be submitted without dropping another one."""
        return self.outbox.room(topic_id)

    def queued(self) -> dict[int, int]:
        """Messages that wait or are partly sent, per topic id."""
        return self.outbox.queued()

    def reconfigure(self, **changes: Any) -> None:
        """Change settings while running.

        :raises ConfigError: for a value out of range, or that cannot change now
        """
        check_live(changes)
        settings = replace(self.settings, **changes)
        if settings.dst_id != self.settings.dst_id:
            raise ConfigError(
                f"dst_id = {settings.dst_id}: another destination needs a restart of the link: repairs combine packets "
                f"to {self.settings.dst_id}, and nobody else may recover these"
            )
        self.settings = settings
        self.outbox.reconfigure(settings)
        if "packet_rate" in changes:
            self._pace.change(settings.packet_rate)

    def knows(self, src_id: int) -> bool:
        """Whether the state of a robot is held at present."""
        return self.neighbours.get(src_id) is not None

    def rows(self, src_id: int) -> Mapping[int, TableRow]:
        """The topics of a robot by topic id, as far as it has announced them."""
        neighbour = self.neighbours.get(src_id)
        return {} if neighbour is None else neighbour.inbox.rows

    @property
    def held_bytes(self) -> int:
        """Memory in use for incomplete messages."""
        return sum(neighbour.inbox.held for neighbour in self.neighbours)

    def unpublished(self, event: Delivered) -> Lost:
        """Count a message that was delivered but not published on the ROS graph. A latched message may come again."""
        neighbour = self.neighbours.get(event.src_id)
        if neighbour is not None:
            neighbour.inbox.marks.pop(event.topic_id, None)
        self.received.lost[event.src_id, event.topic_id, LedgerRow.PUBLISH_FAILED.value] += 1
        return Lost(event.src_id, event.topic_id, LedgerRow.PUBLISH_FAILED, event.key)

    def next_packet(self, now: float) -> bytes | None:
        """The next packet that may go at ``now``, or None."""
        self._now = max(self._now, now)
        if not self.answers or not self._pace.may_leave(now):
            return None
        data = self._compose(now)
        if data is None:
            return None
        self._pace.left(now, waiting=True)
        return data

    def use_credit(self) -> None:
        """See :class:`gr_ros2.link.pace.Pace`."""
        self._pace.use_credit()

    def credit(self, packets: int = 1) -> None:
        """See :class:`gr_ros2.link.pace.Pace`."""
        self._pace.credit(packets)

    @property
    def out_of_credit(self) -> bool:
        """Whether nothing leaves before the next credit."""
        return self._pace.out_of_credit

    def follow(
        self,
        topic_id: int,
        *,
        reliable: bool = True,
        latched: bool = False,
        depth: int = 0,
        lifespan_s: float = 0.0,
        period_s: float = 0.0,
    ) -> bool:
        """Take over the QoS of a topic's publishers, where the configuration leaves it open.

        :return: whether that changed its queue
        """
        before, table = self.queue(topic_id), self.outbox.digest
        kept = {"reliable": reliable, "latched": latched}
        self.outbox.follow(topic_id, **kept, depth=depth, lifespan_s=lifespan_s, period_s=period_s)
        if self.outbox.digest != table:
            self._talk.hurry(self._now)
        return self.queue(topic_id) != before

    @property
    def interval(self) -> float:
        """See :class:`gr_ros2.link.pace.Pace`."""
        return self._pace.interval

    # ---- receiving

    def receive(self, data: bytes, now: float, snr_db: float | None = None) -> list[ReceiverEvent]:
        """See :class:`gr_ros2.link.endpoint.Endpoint`."""
        self._now = max(self._now, now)
        self._repair_at = -inf
        self._receive(data, now, snr_db)
        events, self._events = self._events, []
        return events

    def handle_timeout(self, now: float) -> list[ReceiverEvent]:
        """Do what has become due on the receiving side: give up missing packets, and forget robots that are silent."""
        self._now = max(self._now, now)
        for neighbour in self.neighbours:
            self._report_all(neighbour.inbox.handle_timeout(now))
        self.neighbours.settle(now)
        for gone in self.neighbours.silent(now, GIVE_UP_S):
            self._forget(gone.src_id)
            gone.inbox.told = False
            self._report_all(gone.inbox.handle_timeout(now))
            self._report_all([Gone(gone.src_id, gone.boot)])
        self.outbox.reported = self.window.reported
        events, self._events = self._events, []
        return events

    def next_timeout(self) -> float | None:
        """When ``handle_timeout`` has something to do, if no other method is called before."""
        times = [at for neighbour in self.neighbours if (at := neighbour.inbox.next_timeout()) is not None]
        times += [n.heard + GIVE_UP_S for n in self.neighbours if not n.gone]
        return min(times, default=None)

    def next_departure(self, *, credited: bool = False) -> float | None:
        """See :class:`gr_ros2.link.endpoint.Endpoint`."""
        now = self._now
        if (self.out_of_credit and not credited) or not self.answers:
            return None
        leaving = [self._talk.due]
        waiting = self.outbox.next_timeout(now)
        if waiting is not None:
            leaving.append(waiting)
        if self.settings.hears:
            leaving += [n.inbox.report_due(now) for n in self.neighbours]
            leaving += [now for n in self.neighbours if n.inbox.report_helps]
        if self._repeat_at < inf:
            leaving.append(self._repeat_at)
        if min(leaving) > now and self._mode() != "off" and self.window.unconfirmed(now):
            leaving.append(max(self._repair_at, now if self._mode() == "idle" else self._next_look(now)))
        return max(min(leaving), self._pace.slot)

    def _next_look(self, now: float) -> float:
        """When a thrifty sender may want to repair something."""
        if not self.window.loss:
            return min(now + _CALM_POLL_S, self.window.next_doubt(now))
        return min(now + _POLL_S, self.window.next_doubt(self._calm_since)) if self._calm_since < inf else now

    # ---- what leaves

    def _compose(self, now: float) -> bytes | None:
        self.urged = False
        if not self._started:
            self._start(now)
        outbox, talk = self.outbox, self._talk
        if now >= talk.due:
            waiting = outbox.next_timeout(now)
            idle = waiting is None or waiting > now
            if talk.urgent(now, idle=idle, latency=outbox.urgent, heard=self.window.reported):
                return self._hello(now)
        if now >= self._repeat_at:
            self._repeats = min(2 * self._repeats, MOST_REPEATS) if self._lone else 1
            self._repeat_at = now + self.settings.repeat_s * self._repeats
            if not self.window.reported:
                outbox.announce(now)
        if outbox.deadlines:
            outbox.expire(now, self.interval)
        due: Sequence[Neighbour] = ()
        if self.settings.hears:
            due = [n for n in self.neighbours if n.inbox.report_due(now) <= now]
        if due and self._unheard >= FORCED:
            return self._say(due, now)
        if self.window.pressing and not outbox.urgent and (first := self._first(now)) is not None:
            return first
        filling = outbox.fill(self.window.newest + 1, self._room, now)
        if filling is not None:
            return self._new(filling, due, now)
        if due:
            return self._say(due, now)
        asks = talk.asks(self.neighbours, now, self._room)
        if asks:
            return self._control(asks, "hello", now)
        self.window.mode = self._mode()
        over = self.window.over(now)
        repair = self._repair(now) if over < 0 else self._tell(over, now)
        if repair is not None:
            return repair
        early = [n for n in self.neighbours if n.inbox.report_helps] if self.settings.hears else ()
        return self._say(early, now) if early else None

    def _start(self, now: float) -> None:
        self._started = True
        self._talk.start(now)
        if self.outbox.digest:
            self.outbox.ask(TABLE_TOPIC, now)
            if self.settings.repeat_s:
                self._repeat_at = now + self.settings.repeat_s

    def _new(self, filling: Filling, due: Sequence[Neighbour], now: float) -> bytes:
        """A source packet, with a report where there is room for one."""
        entries = filling.parts
        free = self._room - filling.used
        for neighbour in due:
            if free >= neighbour.inbox.report_len:
                free -= neighbour.inbox.report_len
                entries.append(neighbour.inbox.report(now))
                self._unheard = 0
            else:
                self._unheard += 1
        return self._source(entries, filling.lives, filling.qos, filling.sent, now)

    def _source(
        self, entries: list[Entry], lives: tuple[Life, ...], qos: int, parts: tuple[SentEntry, ...], now: float
    ) -> bytes:
        number = self.window.newest + 1
        body = write_body(entries, self._room)
        header = self._header(qos, number)
        clear = write_header(header)
        data = self._trailer.close(clear, self._padded(body, clear), number, SOURCE_ROW)
        self.window.sent(number, body, data, lives, now)
        self._calm_since = inf
        if lives:
            self._hold.left(now, self.window.loss)
        return self._leave(data, Packet(header, tuple(entries), encrypted=self._encrypts), "new", now, parts)

    def _standing(
        self, standing: Standing, number: int, body: bytes, entries: Sequence[Entry], *, kind: AirKind, now: float
    ) -> bytes:
        header = self._header(QOS_STANDING, number)
        clear = write_header(header) + write_standing(standing)
        body = self._padded(body, clear)
        data = self._trailer.close(clear, body, number, standing.row, plain=standing.clear)
        encrypted = self._encrypts and not standing.clear
        combined = body if standing.mask else b""
        return self._leave(data, Packet(header, tuple(entries), standing, combined, encrypted), kind, now)

    def _control(self, entries: Sequence[Entry], kind: AirKind, now: float, *, clear: bool = False) -> bytes:
        """A packet of entries that are not messages; it stands at the newest number."""
        row = self.window.take_row(self.window.newest)
        if row is None:
            return self._source([], self.window.exhausted(now), 0, (), now)
        body = write_body(entries, self._room)
        over = not self.window.unconfirmed(now)
        return self._standing(
            Standing(row, oldest=over, clear=clear), self.window.newest, body, entries, kind=kind, now=now
        )

    def _repair(self, now: float) -> bytes | None:
        self._repair_at = -inf
        chosen = self.window.next(now, self._held)
        held = self._repair_at > now
        self._calm_since = now if chosen is None and not held else inf
        if chosen is None:
            lives = () if held else self.window.exhausted(now)
            return self._source([], lives, 0, (), now) if lives else None
        self._hold.repaired(waiting=held)
        return self._repaired(chosen, now)

    def _first(self, now: float) -> bytes | None:
        """What goes before new messages: what a receiver lacks or waits for in vain, so that later messages wait."""
        again = self.window.urgent(now)
        if again is not None:
            return self._repaired(again, now)
        over = self.window.over(now, PATIENCE_S)
        return self._tell(over, now) if over >= 0 else None

    def _tell(self, number: int, now: float) -> bytes | None:
        """Say that a packet is not repaired any more."""
        repair = self.window.tell(number, now)
        if repair is not None:
            return self._repaired(repair, now)
        return None if self.window.unconfirmed(now) else self._control([], "repair", now)

    def _repaired(self, chosen: Sent | Repair, now: float) -> bytes:
        if isinstance(chosen, Repair):
            number, mask, row, oldest, combined = chosen
            return self._standing(Standing(row, mask, oldest), number, combined, (), kind="repair", now=now)
        header = read_header(chosen.data, self.settings.packet_len)
        entries = tuple(read_body(chosen.body, self._room))
        return self._leave(chosen.data, Packet(header, entries, encrypted=self._encrypts), "repair", now)

    def _held(self, now: float) -> bool:
        """Whether a repair that could leave now waits for a new message."""
        airtime = self._pace.interval
        self._repair_at = self._hold.until(now, self._pace.free(now) + airtime, airtime)
        return self._repair_at > now

    def _hello(self, now: float) -> bytes:
        quiet = self.window.newest == self._hello_number and not self.window.reported
        if quiet and self._sealed:
            self._hello_number = -1
            return self._source(
                [], (), 0, (), now
            )  # a receiver that restarts takes nothing below the number that it had stored
        self._hello_number = self.window.newest
        outbox = self.outbox
        if self._talk.starting and not self.window.reported:
            outbox.ask(TABLE_TOPIC, now)  # no report says whether it has arrived
        turns, marks = self.window.newest >> 16, outbox.marks(now)
        heard = self.neighbours.heard(self.window.newest)
        entries = self._talk.hello(
            self._room,
            turns,
            outbox.digest,
            marks,
            heard=heard,
            wants=self.neighbours.unproven,
            reported=self.window.reported and self.settings.repair != "off",
            lone=self._lone,
            now=now,
        )
        data = self._control(entries, "hello", now, clear=isinstance(entries[0], Hello))
        self.neighbours.said_hello(data, now)
        for entry in entries:
            if isinstance(entry, Heard):
                self.window.proven(entry.src_id, self.neighbours.since(entry.src_id))
        return data

    def _say(self, due: Sequence[Neighbour], now: float) -> bytes:
        """A packet with reports, and with requests where there is room."""
        entries: list[Entry] = []
        free = self._room
        for neighbour in due:
            if free >= neighbour.inbox.report_len:
                free -= neighbour.inbox.report_len
                entries.append(neighbour.inbox.report(now))
        entries += self._talk.asks(self.neighbours, now, free)
        self._unheard = 0
        return self._control(entries, "report", now)

    def _leave(
        self, data: bytes, packet: Packet, kind: AirKind, now: float, parts: tuple[SentEntry, ...] = ()
    ) -> bytes:
        stats = self.sent
        stats.air[kind] += 1
        stats.packets += 1
        if self._rate is not None:
            self._choose_rung(kind, now)
        if self._observer is not None:
            self._observer(SentPacket(data, packet, parts, now, kind, self.rung))
        return data

    def _choose_rung(self, kind: AirKind, now: float) -> None:
        """Choose the rung of the packet that leaves. Hellos are also for robots that are not known yet."""
        assert self._rate is not None
        rung = self._rate.sent(None if self.settings.dst_id == BROADCAST else self.settings.dst_id, now)
        self.rung = 0 if kind in {"hello", "report"} else rung

    def _padded(self, body: bytes, clear: bytes) -> bytes:
        return body.ljust(self._end_of_body - len(clear), b"\0")

    def _header(self, qos: int, number: int) -> Header:
        settings = self.settings
        hop = HOP if settings.dst_id != BROADCAST else 0
        return Header(qos, self._sealed, settings.src_id, number & 0xFFFF, settings.dst_id, hop)

    def _mode(self) -> RepairMode:
        mode = self.settings.repair
        if not self._pace.known:  # nothing limits how many packets leave: repair only what reports call for
            return "thrifty" if mode != "off" and self.window.reported else "off"
        if mode != AUTO:
            return mode
        return "thrifty" if self.window.reported else "idle"

    # ---- what arrives

    def _receive(self, data: bytes, now: float, snr_db: float | None = None) -> None:
        try:
            opened = self._open(data, now)
            if opened is None:
                return
            if snr_db is not None and opened.new:
                opened.neighbour.inbox.measured(snr_db)
            proved = self._use(data, opened, now)
        except WireError as error:
            self.received.rejected[error.kind] += 1
            self._report_all([Rejected(data, error)])
            return
        if opened.met or proved:
            for early in self.neighbours.early(opened.neighbour.src_id):
                self._receive(early, now)

    def _open(self, data: bytes, now: float) -> Opened | None:
        header = read_header(data, self.settings.packet_len)
        if header.src_id == self.settings.src_id:
            self.neighbours.check_own(data, header)
            self.received.dropped["own"] += 1
            return None
        if header.dst_id not in (BROADCAST, self.settings.src_id) and self.settings.src_id != NOBODY:
            self.received.dropped["not_for_us"] += 1
            return None
        if header.sealed and not self._sealed:
            raise NoKeyError(f"a sealed packet of robot {header.src_id}, and no key is configured here")
        if self._sealed and not header.sealed:
            raise NotSealedError(f"a packet of robot {header.src_id} that is not sealed, where a key is configured")
        return self.neighbours.open(data, header, now)

    def _use(self, data: bytes, opened: Opened, now: float) -> bool:
        """Take an opened packet; returns whether packets that were kept until a proof can be taken now."""
        self.received.packets += 1
        proved = False
        neighbour, number, standing = opened.neighbour, opened.number, opened.standing
        control = standing is not None and not standing.mask
        self.urged = self.urged or control or self._talk.lacking
        if opened.met:
            self._meet(opened, now)
        inbox = neighbour.inbox
        self._sender = neighbour
        room = body_room(self.settings.packet_len, sealed=self._sealed, addressed=opened.header.dst_id != BROADCAST)
        encrypted = neighbour.encrypts and not (standing is not None and standing.clear)
        if standing is None:
            entries = read_body(opened.body, room)
            self._report_all([Received(data, Packet(opened.header, tuple(entries), encrypted=encrypted))])
            self._report_all(inbox.source(number, opened.body, entries, opened.header.qos, now))
        elif standing.mask:
            self._report_all([Received(data, Packet(opened.header, (), standing, opened.body, encrypted))])
            self._report_all(
                inbox.repair(
                    number,
                    standing.mask,
                    standing.row,
                    opened.body,
                    oldest=standing.oldest,
                    now=now,
                    new=opened.new,
                )
            )
        else:
            entries = opened.entries if opened.entries is not None else read_body(opened.body, room)
            self._report_all([Received(data, Packet(opened.header, tuple(entries), standing, b"", encrypted))])
            if standing.clear:
                neighbour.echo = data[-ECHO_LEN:], self.window.newest
                if neighbour.hello.capabilities & WANTS_PROOF:
                    self._talk.answer(now)
            proved = self.neighbours.proved(neighbour, number, entries)
            for entry in entries:
                if isinstance(entry, Hello):
                    inbox.told = self.settings.hears and entry.capabilities & REPORTED != 0
                elif isinstance(entry, (Ask, Report)):
                    self._entry(entry)
            self._report_all(inbox.heard(number, now, over=standing.oldest))
        return proved

    def _meet(self, opened: Opened, now: float) -> None:
        """A robot is heard for the first time, or is heard again."""
        neighbour = opened.neighbour
        if opened.replaced is not None:
            self._report_all(opened.replaced.inbox.close(LedgerRow.SENDER_RESTARTED))
        self._forget(neighbour.src_id)
        hears = neighbour.hello.capabilities & CAN_HEAR != 0
        if hears:
            self.window.meet(neighbour.src_id, now)
            if self._rate is not None:
                self._rate.meet(neighbour.src_id)
            self.outbox.reported = True
        if self._repeats > 1:
            self._repeats, self._repeat_at = 1, now + self.settings.repeat_s
        if self.settings.hears:
            self._talk.met(now)
        self._report_all([Met(neighbour.src_id, neighbour.boot, hears)])

    def _entry(self, entry: Control) -> None:
        """Handle an entry that is not a message, from the sender of the packet that is processed."""
        assert self._sender is not None
        own, now = self.settings.src_id, self._now
        if isinstance(entry, Report):
            if entry.src_id != own or entry.boot != self.boot & 0xFFFF:
                return
            newest = self.window.newest
            number = newest - ((newest - entry.number) & 0xFFFF)
            if number < 0:
                raise EntryKindError(f"a report of packet {entry.number}, which was never sent")
            loss = entry.loss / 128
            sender = self._sender.src_id
            self.window.report(sender, number, entry.arrived, settled=entry.settled, loss=loss, now=now)
            self._calm_since = inf
            self.outbox.reported = True
            if self._rate is not None and entry.snr_db is not None:
                self._rate.report(sender, entry.snr_db, loss, now)
        elif isinstance(entry, Ask) and entry.src_id == own:
            for topic_id in entry.topic_ids:
                self.outbox.ask(topic_id, now)

    @property
    def _lone(self) -> bool:
        """Whether no robot is heard, though one could be."""
        return self.settings.hears and all(neighbour.gone for neighbour in self.neighbours)

    def _forget(self, src_id: int) -> None:
        """A receiver is gone, or has started again."""
        self.window.forget(src_id)
        if not self.window.reported:
            self._talk.hurry(self._now)
        if self._rate is not None:
            self._rate.forget(src_id)

    def _inbox(self, src_id: int, boot: int, first: int, room: int) -> Inbox:
        return Inbox(
            src_id,
            boot,
            first,
            room,
            self.settings,
            rows=self._rows,
            decoder_for=self._decoder_for,
            marks=self._marks.setdefault(src_id, {}),
            stats=self.received,
            control=self._entry,
        )

    def _report_all(self, events: Sequence[ReceiverEvent]) -> None:
        stats = self.received
        for event in events:
            self._events.append(event)
            if isinstance(event, Delivered):
                stats.delivered[event.src_id, event.topic_id] += 1
                stats.repaired[event.src_id, event.topic_id] += event.repaired
            elif isinstance(event, Lost):
                stats.lost[event.src_id, event.topic_id, str(event.reason)] += 1
                stats.message_loss_est += 1
