"""What arrives: packets are opened, taken, and reported as events; and as facts, where they matter to what is sent.

Invariant: ``receive`` never raises, whatever the bytes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from math import inf

from gr_ros2.core.errors import EntryKindError, NoKeyError, NotSealedError, WireError
from gr_ros2.link.access import Access
from gr_ros2.link.events import (
    AirPacket,
    Delivered,
    Gone,
    Lost,
    Met,
    Received,
    ReceiverEvent,
    Rejected,
)
from gr_ros2.link.fates import Fate
from gr_ros2.link.message_codec import MessageCodec
from gr_ros2.link.v1.announced import ARRIVING_S
from gr_ros2.link.v1.custody import Custody
from gr_ros2.link.v1.endpoint_settings import Settings
from gr_ros2.link.v1.facts import (
    TAKEN,
    Appeared,
    Asked,
    Early,
    Fact,
    Has,
    PeerLeft,
    PeerMet,
    ProofWanted,
    Questioned,
    Reported,
)
from gr_ros2.link.v1.inbox import Inbox
from gr_ros2.link.v1.neighbours import Neighbour, Neighbours, Opened
from gr_ros2.link.v1.outcomes import Outcomes
from gr_ros2.link.v1.overtaking import Overtaken
from gr_ros2.link.v1.peers import REACH
from gr_ros2.link.v1.relaying import Relaying
from gr_ros2.link.v1.replays import Save
from gr_ros2.link.v1.sealing import NOT_A_REPAIR, Keys
from gr_ros2.link.v1.sent_packets import SentPackets
from gr_ros2.relay.robots import GONE_S, NEAR_S, QUIET_S, OtherRobots
from gr_ros2.settings.config import NOBODY
from gr_ros2.wire.control import (
    CAN_HEAR,
    ECHO_LEN,
    REPORTED,
    WANTS_PROOF,
    About,
    Ask,
    Control,
    Hello,
    LeftOut,
    Newest,
    Ping,
    Report,
)
from gr_ros2.wire.mac_block import read_block
from gr_ros2.wire.table import AnnouncedTopic
from gr_ros2.wire.v1 import BROADCAST, TABLE_TOPIC, EntryV1, Header, PacketV1, RepairHeader, read_body, read_header


class ReceivingSide:
    """The receiving half of one robot.

    :param decoder_for: makes the decoder for a robot's messages from its table of topics
    :param heard: what ``save`` stored before this start
    :param sent: what has left, of which reports speak
    :param custody: makes what keeps messages for single robots, where messages of others are sent on
    :param access: is told what is heard on a channel that others share
    :param tells_snr: whether reports say how strong packets are
    :ivar stats: what arrived and what did not
    :ivar neighbours: the robots that are heard
    :ivar relaying: what is sent on of what others make; None where nothing is
    """

    def __init__(
        self,
        settings: Settings,
        boot: int,
        keys: Keys,
        sent: SentPackets,
        *,
        decoder_for: Callable[[tuple[AnnouncedTopic, ...]], MessageCodec] | None,
        custody: Callable[..., Custody],
        access: Access | None = None,
        tells_snr: bool = False,
        heard: Mapping[int, tuple[int, int]],
        save: Save | None,
    ) -> None:
        self._access = access
        self._takes = range(256) if settings.src_id == NOBODY else (BROADCAST, settings.src_id)
        """The destinations of packets that are for this robot."""
        self._sent, self._tells_snr = sent, tells_snr
        self._outcomes = Outcomes()
        self.stats = self._outcomes.stats
        self._settings = settings
        self._boot = boot
        self._sealed = keys.sealed
        self._decoder_for = decoder_for
        self._marks: dict[int, dict[int, tuple[int, ...]]] = {}
        """CRC-32 of the latched messages of every robot; kept when the robot restarts."""
        self._learned: dict[int, Overtaken] = {}
        """Of the packets of every robot."""
        own, robots = (settings.src_id, boot), OtherRobots(lambda: settings.slower)
        self.neighbours = Neighbours(
            own, robots, settings, keys, heard=heard, save=save, inbox=self._inbox, dropped=self.stats.dropped
        )
        self.relaying: Relaying | None = None
        if settings.relay:
            self.relaying = Relaying(
                settings.src_id,
                robots,
                self.neighbours,
                self._outcomes,
                lambda src_id, boot, first: self._inbox(src_id, boot, first, settings.packet_len, far=True),
                custody=custody,
                packet_len=settings.packet_len,
                repairs=settings.repair != "off",
                most=settings.max_source_bytes,
                tuning=settings.tuning,
            )
        self._now = -inf
        self._sender: Neighbour | None = None
        """The sender of the packet that is processed."""

    def receive(
        self, arrival: AirPacket, now: float, came: float | None = None
    ) -> tuple[list[ReceiverEvent], list[Fact]]:
        """Take one packet; the events that it causes, and what matters to what is sent, each in order.

        :param came: when it came, s, where it was kept since then
        """
        self._now = now
        began = now if self._access is None or arrival.at is None else min(arrival.at, now)
        try:
            self._receive(arrival, now, began if came is None else came)
        except WireError as error:
            self.stats.rejected[error.kind] += 1
            self._outcomes.events.append(Rejected(arrival.data, error.alone()))
        return self._outcomes.take(), self._outcomes.take_facts()

    def handle_timeout(self, now: float) -> tuple[list[ReceiverEvent], list[Fact]]:
        """Give up missing packets, and forget robots that are silent; returns as ``receive`` does."""
        self._now = now
        for neighbour in self.neighbours.all.values():
            neighbour.inbox.handle_timeout(now)
        self.neighbours.settle(now)
        for gone in self.neighbours.silent(now, self._give_up_s):
            self._outcomes.facts.append(PeerLeft(gone.src_id, ended=False))
            if self.relaying is None or not self.relaying.far.reaches(gone.src_id, gone.boot, now):
                self._outcomes.events.append(Gone(gone.src_id, gone.boot))
        if self.relaying is not None:
            self.relaying.far.handle_timeout(now)
        for neighbour in self.neighbours.all.values():
            neighbour.timeout = None
        return self._outcomes.take(), self._outcomes.take_facts()

    def next_timeout(self) -> float | None:
        """When ``handle_timeout`` has something to do, if no other method is called before."""
        # Asked after each packet, so only its sender is looked at anew.
        times = [n.timeout if n.timeout is not None else self._timeout(n) for n in self.neighbours.all.values()]
        if self.relaying is not None and (at := self.relaying.far.next_timeout()) is not None:
            times.append(at)
        soonest = min(times, default=inf)
        return None if soonest == inf else soonest

    @property
    def _give_up_s(self) -> float:
        return GONE_S * self._settings.slower

    def _timeout(self, neighbour: Neighbour) -> float:
        waits = neighbour.inbox.next_timeout()
        gone = inf if neighbour.silent else neighbour.heard + self._give_up_s
        neighbour.timeout = gone if waits is None else min(waits, gone)
        return neighbour.timeout

    def unpublished(self, event: Delivered) -> Lost:
        """Count a message that was delivered but not published on the ROS graph. A latched message may come again."""
        neighbour = self.neighbours.all.get(event.src_id)
        if neighbour is not None:
            neighbour.inbox.deliveries.marks.pop(event.topic_id, None)
        self.stats.lost[event.src_id, event.topic_id, Fate.PUBLISH_FAILED.value] += 1
        return Lost(event.src_id, event.topic_id, Fate.PUBLISH_FAILED, event.key)

    def _receive(self, arrival: AirPacket, now: float, began: float) -> None:
        """Take a packet that began to arrive at a time, s."""
        header = read_header(arrival.data, self._settings.packet_len)
        opened = self._open(arrival.data, header, now)
        if self._access is not None and (opened is None or opened.new):  # what was here says nothing about now
            self._note_slot(self._access, header, arrival, now, opened)
        if opened is None or opened.kept:
            return
        opened.neighbour.timeout = None
        if self._access is not None and header.dst_id not in self._takes:
            self.stats.dropped["not_for_us"] += 1
            return
        if arrival.snr_db is not None and opened.new and opened.trusted:
            opened.neighbour.inbox.reports.snr.measured(arrival.snr_db)
        self._use(arrival, opened, now, began)
        if opened.met and (early := self.neighbours.early(opened.neighbour.src_id, now)):
            self._outcomes.facts.append(Early(early))

    def _note_slot(self, access: Access, header: Header, arrival: AirPacket, now: float, opened: Opened | None) -> None:
        """Tell medium access what was heard, and when its burst began; and relaying whom the sender hears."""
        if arrival.at is None or header.src_id == self._settings.src_id:
            return
        block = read_block(header.block)[0] if header.block else None
        trusted = opened is not None and opened.trusted
        checked = opened is not None and (trusted or self.neighbours.proves_soon(opened.neighbour))
        access.hear(header.src_id, block, arrival.at, trusted=trusted, checked=checked)
        if opened is not None and block is not None and self._settings.src_id in block.names:
            opened.neighbour.knows = True
        if self.relaying is not None and trusted:
            self.relaying.heard(header.src_id, block, now)

    def _open(self, data: bytes, header: Header, now: float) -> Opened | None:
        own = self._settings.src_id
        if header.src_id == own:
            self.neighbours.check_own(data, header)
            self.stats.dropped["own"] += 1
            return None
        # Where a channel is shared, all have to know whose slot it is.
        if self._access is None and header.dst_id not in self._takes:
            self.stats.dropped["not_for_us"] += 1
            return None
        if header.sealed and not self._sealed:
            raise NoKeyError(f"a sealed packet of robot {header.src_id}, and no key is configured here")
        if self._sealed and not header.sealed:
            raise NotSealedError(f"a packet of robot {header.src_id} that is not sealed, where a key is configured")
        return self.neighbours.open(data, header, now)

    def _use(self, arrival: AirPacket, opened: Opened, now: float, began: float) -> None:
        """Take an opened packet that began to arrive at a time, s."""
        self.stats.packets += 1
        neighbour, header, number, repair = opened.neighbour, opened.header, opened.number, opened.repair
        urgent = repair is not None and not repair.mask
        self._outcomes.facts.append(TAKEN[opened.trusted or opened.appeared, urgent])
        if opened.appeared:
            self._appear(opened, now)
        if opened.met:
            self._meet(neighbour, now)
        self._sender, inbox = neighbour, neighbour.inbox
        mask, clear, repair_id = 0, False, NOT_A_REPAIR
        if repair is not None:
            mask, clear, repair_id = repair.mask, repair.clear, repair.repair_id
        entries: Sequence[EntryV1] = ()
        if not mask:
            if self.relaying is not None and opened.new and opened.trusted:
                self.relaying.reached(neighbour, number, began)
            entries = opened.entries or read_body(opened.body, header.room(self._settings.packet_len))
        encrypted = neighbour.trailer.encrypts and not clear
        packet = PacketV1(header, tuple(entries), repair, opened.body if mask else b"", encrypted)
        received = Received(
            arrival.data, packet, neighbour.src_id, neighbour.boot, number, repair_id, arrival.at, arrival.snr_db
        )
        self._outcomes.events.append(received)
        if repair is None:
            if self._access is not None and not header.sealed:
                self._joined(neighbour, number, entries)
            inbox.source(number, opened.body, entries, header.qos, now, began=began)
        elif mask:
            inbox.repair(
                number, mask, repair_id, opened.body, oldest=repair.oldest, now=now, began=began, new=opened.new
            )
        else:
            self._control(arrival, opened, repair, entries, now, began=began)

    def _control(
        self,
        arrival: AirPacket,
        opened: Opened,
        repair: RepairHeader,
        entries: Sequence[EntryV1],
        now: float,
        *,
        began: float,
    ) -> None:
        """Take a packet of entries that are not messages. One that is not trusted moves nothing but the proofs."""
        neighbour, number = opened.neighbour, opened.number
        inbox = neighbour.inbox
        if repair.clear:
            neighbour.echo = arrival.data[-ECHO_LEN:], self._sent.newest
            if neighbour.hello.capabilities & WANTS_PROOF and not self._answered(neighbour, entries, now, began):
                self._outcomes.facts.append(ProofWanted())
        if not opened.trusted:
            if not repair.clear:
                self.stats.dropped["unproven"] += 1
            return
        for entry in entries:
            if isinstance(entry, Hello):
                self._greeted(neighbour)
            elif isinstance(entry, (Ask, Report, Newest, LeftOut)):
                self._entry(entry)
            elif isinstance(entry, (Ping, About)):
                self._outcomes.facts.append(Questioned(neighbour.src_id, entry))
        inbox.heard(number, now, began, over=repair.oldest)

    def _joined(self, neighbour: Neighbour, number: int, entries: Sequence[EntryV1]) -> None:
        """Take the hello, if there is one, in a packet of messages."""
        for entry in entries:
            if isinstance(entry, Hello) and entry.boot == neighbour.boot:
                self.neighbours.greeted(neighbour, entry, number)
                self._greeted(neighbour)

    def _appear(self, opened: Opened, now: float) -> None:
        """Something of a robot comes for the first time, or again: it is answered, so that it can prove that it hears
        this start."""
        if opened.replaced is not None:
            opened.replaced.inbox.ended(now)
            self._outcomes.facts.append(PeerLeft(opened.replaced.src_id, ended=True))
            if self.relaying is not None:
                self.relaying.started(opened.replaced, now)
        self._outcomes.facts.append(Appeared(opened.neighbour.knows))

    def _answered(self, neighbour: Neighbour, entries: Sequence[EntryV1], now: float, began: float) -> bool:
        """Whether a robot whose hello says that it lacks a proof means other robots, or an answer is under way."""
        if self._access is None or self._settings.slower <= 1:
            return False
        since = 2 * began - now - self._access.lead_s  # another packet took as long, and this one was written before
        return self.neighbours.own_hellos.knows((neighbour.src_id, neighbour.boot), entries, since)

    def _meet(self, neighbour: Neighbour, now: float) -> None:
        """A robot is heard for the first time, or is heard again."""
        hears = neighbour.hello.capabilities & CAN_HEAR != 0
        if hears and self._settings.dst_id in (BROADCAST, neighbour.src_id):
            proof = self.neighbours.since(neighbour.src_id) if neighbour.proves else ()
            self._outcomes.facts.append(PeerMet(neighbour.src_id, *proof))
        self._outcomes.events.append(Met(neighbour.src_id, neighbour.boot, hears))
        if self.relaying is not None:
            self.relaying.far.met(neighbour, now)
        self._greeted(neighbour)
        if self._settings.turns_are_rare:  # its table comes unasked
            neighbour.asked[TABLE_TOPIC] = now + ARRIVING_S * self._settings.slower
        if neighbour.proofs.proven is not None:
            neighbour.inbox.order.repaired_from(neighbour.proofs.proven - REACH)

    def _greeted(self, neighbour: Neighbour) -> None:
        """The newest hello of a robot that is heard."""
        if self._settings.hears and neighbour.hello.capabilities & REPORTED:
            neighbour.inbox.order.reported()

    def _entry(self, entry: Control) -> None:
        """Handle an entry that is not a message, from the sender of the packet that is processed."""
        assert self._sender is not None
        if isinstance(entry, Report):
            self._reported(self._sender.src_id, entry)
        elif isinstance(entry, LeftOut):
            self._sender.inbox.left_out(entry)
        elif isinstance(entry, Newest):
            if entry.origin == self._settings.src_id:
                self._has(self._sender.src_id, entry)
            elif self.relaying is not None:
                self.relaying.newest(self._sender.src_id, entry, self._now)
        elif isinstance(entry, Ask) and entry.src_id == self._settings.src_id:
            self._outcomes.facts.append(Asked(self._sender.src_id, tuple(dict.fromkeys(entry.topic_ids))))

    def _reported(self, sender: int, report: Report) -> None:
        """A robot says which packets it has."""
        if report.src_id != self._settings.src_id or report.boot != self._boot & 0xFFFF:
            return
        newest = self._sent.newest
        number = newest - ((newest - report.number) & 0xFFFF)
        if number < 0:
            raise EntryKindError(f"a report of packet {report.number}, which was never sent")
        self._outcomes.facts.append(Reported(sender, number, report))

    def _has(self, sender: int, newest: Newest) -> None:
        """A robot says which messages of this one it has."""
        if newest.place is not None and newest.start == self._boot & 0xFF and newest.number <= self._sent.newest:
            self._outcomes.facts.append(Has(sender, newest.topic_id, (newest.number, newest.place)))

    def _brings(self, since: float) -> bool:
        """Whether a robot that is heard still repairs something that was missing at this time, s."""
        heard = [neighbour for neighbour in self.neighbours.all.values() if not neighbour.silent]
        return any(neighbour.inbox.order.missing_since() <= since for neighbour in heard)

    def _inbox(
        self,
        src_id: int,
        boot: int,
        first: int,
        room: int,
        sealed_after: Callable[[int], float] | None = None,
        *,
        far: bool = False,
    ) -> Inbox:
        return Inbox(
            src_id,
            boot,
            first,
            room,
            self._settings,
            decoder_for=self._decoder_for,
            marks=self._marks.setdefault(src_id, {}),
            learned=self._learned.setdefault(src_id, Overtaken(self._settings.tuning)),
            outcomes=self._outcomes,
            control=self._entry,
            relaying=self.relaying,
            give_up_s=self._give_up_s,
            quiet_s=NEAR_S * self._settings.slower,
            patience_s=QUIET_S * self._settings.slower if far else inf,
            brings=self._brings,
            tells_snr=self._tells_snr,
            sealed_after=sealed_after,
        )
