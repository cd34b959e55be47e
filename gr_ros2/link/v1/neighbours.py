"""The robots that are heard: the current start of each, how its packets are opened, and which packets are refused.

A robot's packets can be opened once a hello has told its boot number. Packets that arrive shortly before the hello are
kept until then. Where packets are not sealed, a packet of messages may bring the hello itself.

*Replays.* Where packets are sealed and two robots hear each other, a packet of messages is used only if it was sealed
after this robot started, which the other robot proves (``proofs``). Packets that arrive before the first proof are kept
until then. Control packets are opened for the proofs in them, and are trusted only as packets of messages are: before
its first proof a robot is not heard. Of a robot that can prove nothing, a number is stored below which nothing is
accepted (``replays``).

An older start of a robot is accepted only with a proof; where packets are not sealed, any other start is accepted a
second after the last one. A robot whose boot number is stored was heard before this robot restarted, so its packets
count from the first hello on, and no message comes out twice.

Invariants: no body is given out that was not opened; no control packet is given out twice; work per packet is bounded;
where packets are sealed, nothing is given out that was sealed before this start and could be a replay.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from gr_ros2.core.errors import (
    CrcError,
    ReplayedError,
    SameIdError,
    SourcesError,
    TagError,
    WireError,
    WrongKeyError,
)
from gr_ros2.link.v1.endpoint_settings import Settings
from gr_ros2.link.v1.inbox import Inbox
from gr_ros2.link.v1.peers import START
from gr_ros2.link.v1.proofs import OwnHellos, Proofs
from gr_ros2.link.v1.replays import Floor, Floors, Save
from gr_ros2.link.v1.sealing import NOT_A_REPAIR, Keys, Trailer
from gr_ros2.relay.robots import OtherRobots
from gr_ros2.wire.control import CAN_HEAR, ENCRYPTS, READS_LEFT_OUT, WANTS_PROOF, Heard, Hello
from gr_ros2.wire.v1 import (
    QOS_REPAIR,
    EntryV1,
    Header,
    RepairHeader,
    hello_in,
    read_body,
    read_repair_header,
)

_HALF = 1 << 15
_EARLY = 64
"""Number of packets kept per robot that cannot be opened yet."""
_EARLY_S = 30.0
"""s for which they are kept: hellos come more often, and where none came for so long, nobody waits for them."""
_CHANGE_S = 1.0
"""s after which another start of a robot that does not seal is taken: forged hellos silence it for half of the time at
most, and a robot that restarts is met soon. What an earlier start has sent arrives within that time."""
_STARTS = 256
"""Starts that have ended of which is known how far they were heard."""
_NUMBERS_KEPT = 512
"""Packet numbers, counted back from the newest, for which it is known which repair ids were used."""
_HANDSHAKE = 8
"""Packets of each robot that is heard, after which one that has proven nothing is taken for a recording: its hello, the
answers of the others, and its answer to these."""
_TABLE_S = 3.0
"""s for which the table of a robot that is heard may be under way."""
_DOUBLED_S = 60.0
"""s for which a robot is said to be two after both were last there."""
_MOST = 1 << 48
"""Number of packets that a start of a robot can have."""


@dataclass(slots=True, eq=False)
class Neighbour:
    """One start of one robot."""

    src_id: int
    boot: int
    trailer: Trailer
    inbox: Inbox
    hello: Hello
    hello_number: int
    """The packet number at which its newest hello stands."""
    heard: float
    floor: Floor
    proofs: Proofs
    proves: bool
    """Whether it can prove when it sealed a packet: it hears this robot, and packets are sealed."""
    appeared_at: int = 0
    """How many packets had been opened when it appeared."""
    knows: bool = False
    """Whether it has said that it has heard this start of this robot, on a channel that others share."""
    silent: bool = False
    """Whether nothing of it has come for long."""
    repair_ids: dict[int, int] = field(default_factory=dict)
    """Repair ids of packets that carried entries, as bits, by packet number."""
    asked: dict[int, float] = field(default_factory=dict)
    """When each topic was requested."""
    lost_frames: set[int] = field(default_factory=set)
    """Topics of which a frame could not be decoded, so that a key frame is to be requested."""
    echo: tuple[bytes, int] | None = None
    """The end of its newest hello, and the number that this robot had reached then."""
    timeout: float | None = None
    """When something of it is to be given up, s; infinite for never, None while nobody has looked since its newest
    packet. Only what it sends can bring this forward."""

    @property
    def proven(self) -> bool:
        """Whether anything shows that it is not a recording: a proof, where it can prove something."""
        return not self.proves or self.proofs.proven is not None

    @property
    def gone(self) -> bool:
        """Whether it does not count as heard: it has been silent for long, or has proven nothing yet."""
        return self.silent or not self.proven

    def number(self, low: int) -> int:
        """The full packet number for its low 16 bits: the one nearest to the newest."""
        newest = self.inbox.decoder.newest
        number = newest + ((low - newest + _HALF) & 0xFFFF) - _HALF
        if not 0 <= number < _MOST:
            raise ReplayedError(f"packet {low} of robot {self.src_id} is older than its start")
        return number

    def new(self, number: int, repair_id: int) -> bool:
        """Whether a packet was not here before, as far as this is known; notes the repair id of a repair packet."""
        decoder = self.inbox.decoder
        if repair_id == NOT_A_REPAIR:
            return number not in decoder.bodies and number >= decoder.floor
        oldest = decoder.newest - _NUMBERS_KEPT
        used = self.repair_ids.get(number, 0)
        if used >> repair_id & 1 or number <= oldest:
            return False
        self.repair_ids[number] = used | 1 << repair_id
        if len(self.repair_ids) > 2 * _NUMBERS_KEPT:
            self.repair_ids = {number: used for number, used in self.repair_ids.items() if number > oldest}
        return True


@dataclass(slots=True)
class Opened:
    """A packet whose trailer was checked.

    ``kept``: it can be used after a proof only, and was kept until then;
    ``appeared``: it is of a start that was not known before, or of a robot that was silent for long; ``met``: its
    sender counts as heard from now on; ``trusted``: it was sealed after this start of this robot, as far as its sender
    can prove that; ``replaced``: the robot start that is now forgotten, if any; ``new``: it was not here before.
    """

    neighbour: Neighbour
    header: Header
    number: int
    repair: RepairHeader | None
    body: bytes
    entries: list[EntryV1] | None = None
    kept: bool = False
    appeared: bool = False
    met: bool = False
    trusted: bool = True
    replaced: Neighbour | None = None
    new: bool = True


class Neighbours:
    """All robots that are heard.

    :param own: id and boot number of this robot
    :param robots: all others
    :param heard: what ``save`` has stored, by robot id: boot number and packet number
    :param dropped: counts packets that are kept (``early``), packets that may have been sealed before this robot
        started (``unproven``), and failures of ``save`` (``state_not_written``)
    :ivar all: the robots, by id
    :ivar own_hellos: what others can prove to have heard
    :param inbox: makes the inbox of a start of a robot: (src_id, boot, first packet that may be needed, bytes of its
        longest body, what tells when a packet was sealed)
    """

    def __init__(
        self,
        own: tuple[int, int],
        robots: OtherRobots,
        settings: Settings,
        keys: Keys,
        *,
        heard: Mapping[int, tuple[int, int]],
        save: Save | None,
        inbox: Callable[..., Inbox],
        dropped: Counter[str],
    ) -> None:
        self.dropped = dropped
        self._own, self._robots = own, robots
        self._settings = settings
        self._keys = keys
        self._trailer_len = keys.trailer_len
        self._provable = keys.sealed and settings.hears
        self.floors = Floors(heard, save, dropped)
        self._stores = save is not None and keys.sealed
        self.own_hellos = OwnHellos(own[0])
        self._make_inbox = inbox
        self.all: dict[int, Neighbour] = {}
        self._early: dict[int, deque[tuple[float, bytes]]] = {}
        self._packets = self._met_first = 0
        """Packets that were opened; so many of them when a robot was met and no other one was heard."""
        self._ended: dict[tuple[int, int], int] = {}
        """By id and boot number of a start that was replaced: the first packet of it that was not heard."""
        self._again: dict[tuple[int, int], float] = {}
        """By id and low 16 bits of the boot number of another start: when it sent something first, s."""

    def early(self, src_id: int, now: float) -> list[tuple[float, bytes]]:
        """Packets of a robot that could not be opened before, and when they came, s; they are returned once."""
        return [(at, data) for at, data in self._early.pop(src_id, ()) if now <= at + _EARLY_S * self._settings.slower]

    def silent(self, now: float, after: float) -> list[Neighbour]:
        """Robots that do not count as heard any more after so many s of silence. Their state is kept until another
        robot needs the room."""
        silent = [n for n in self.all.values() if n.heard + after <= now and not n.silent]
        heard = [neighbour for neighbour in silent if neighbour.proven]
        for neighbour in silent:
            neighbour.silent = True
        return heard

    def open(self, data: bytes, header: Header, now: float) -> Opened | None:
        """Open a packet.

        :return: None if it is kept until a hello comes, or dropped because it is not proven
        :raises WireError: the packet cannot be opened, or must not be
        """
        start, end = header.size, len(data) - self._trailer_len
        repair = None
        if header.qos == QOS_REPAIR:
            repair = read_repair_header(data, start, end)
            if repair.clear:
                return self._hello(data, header, repair, now)
            start += repair.size
        neighbour = self.all.get(header.src_id)
        if neighbour is None:
            if repair is None and self._greets(data, header):
                return self._hello(data, header, None, now)
            self._keep(header.src_id, data, now)
            self.dropped["early"] += 1
            return None
        number = neighbour.number(header.number)
        repair_id = NOT_A_REPAIR if repair is None else repair.repair_id
        try:
            body = neighbour.trailer.open(data[:start], data[start:], number, repair_id)
        except (CrcError, TagError):
            if repair is None and self._greets(data, header):
                return self._hello(data, header, None, now)
            self._keep(header.src_id, data, now)
            raise
        control = repair is not None and not repair.mask
        if not control and neighbour.proves:
            if neighbour.proofs.proven is None:
                self._keep(header.src_id, data, now)
                self.dropped["early"] += 1
                self._packets += 1
                return Opened(neighbour, header, number, repair, b"", kept=True, trusted=False)
            if number <= neighbour.proofs.proven:
                self.dropped["unproven"] += 1
                return None
        new = neighbour.new(number, repair_id)
        if control and not new:
            raise ReplayedError(f"repair id {repair_id} at packet {number} of robot {header.src_id} was here before")
        entries = read_body(body, header.room(self._settings.packet_len)) if control else None
        return self._opened(Opened(neighbour, header, number, repair, body, entries, new=new), now)

    def _opened(self, opened: Opened, now: float) -> Opened:
        """Take the proofs in a packet that was opened, and note what it says about its sender."""
        neighbour, number, repair = opened.neighbour, opened.number, opened.repair
        proofs = neighbour.proofs
        gone = neighbour.silent or opened.appeared or (neighbour.proves and proofs.proven is None)
        self._packets += 1
        alone = gone and self.alone
        if opened.entries is not None and repair is not None:
            for since, at in self.own_hellos.proofs(number, opened.entries, proofs.not_before):
                proofs.take(since, at, (number, repair.repair_id))
            opened.trusted = not neighbour.proves or proofs.covers(number, repair.repair_id)
        if opened.new and (opened.trusted or not neighbour.proven):
            opened.appeared = opened.appeared or neighbour.silent
            neighbour.heard, neighbour.silent = now, False
            if self._stores and not neighbour.proves:
                self.floors.guard(neighbour.floor, number, now)
        if opened.appeared:
            neighbour.appeared_at = self._packets
        opened.met = gone and not neighbour.gone
        if opened.met and alone:
            self._met_first = self._packets
        return opened

    def _proves(self, hello: Hello) -> bool:
        return self._provable and hello.capabilities & CAN_HEAR != 0

    def proves_soon(self, neighbour: Neighbour) -> bool:
        """Whether a robot has appeared so lately that its first proof may still be under way."""
        if neighbour.proven or self.alone:
            return not neighbour.proven
        return self._packets - max(neighbour.appeared_at, self._met_first) <= _HANDSHAKE * len(self.all)

    @property
    def alone(self) -> bool:
        """Whether no robot counts as heard."""
        return all(neighbour.gone for neighbour in self.all.values())

    @property
    def unproven(self) -> bool:
        """Whether a robot is heard whose messages cannot be taken before it has proven that it hears this start."""
        return any(not n.proven and not n.silent for n in self.all.values())

    def sent_by_another_start(self, src_id: int, boot: int, at: float, now: float) -> None:
        """Note that a start of a robot that is not the present one has sent something.

        :param boot: number of that start, or its low 16 bits
        :param at: when, s. What was sent before the present start was met says nothing
        """
        robot = self._robots.of(src_id)
        if at > max(robot.met, robot.met_over):
            first = self._again.setdefault((src_id, boot & 0xFFFF), at)
            if at > first + _CHANGE_S * self._settings.slower:  # later than all that was under way
                robot.doubled = now
            if len(self._again) > _STARTS:
                del self._again[next(iter(self._again))]

    def doubled(self, src_id: int, now: float) -> bool:
        """Whether two robots send under this number: both were there lately, in turns. A robot that restarts never
        comes back as it was before."""
        return now < self._robots.of(src_id).doubled + _DOUBLED_S

    def reads_left_out(self, src_id: int) -> bool:
        """Whether a robot says that it reads which packets are left out."""
        neighbour = self.all.get(src_id)
        return neighbour is not None and neighbour.hello.capabilities & READS_LEFT_OUT != 0

    def lacks_table(self, neighbour: Neighbour, now: float) -> bool:
        """Whether a robot has topics, and nothing of its table has come although it has been heard for long."""
        waits = now - self._robots.of(neighbour.src_id).met > _TABLE_S * self._settings.slower
        return waits and neighbour.hello.digest != 0 and not neighbour.inbox.announced.digest

    def heard(self, newest: int) -> list[Heard]:
        """What proves to other robots that they were heard.

        :param newest: number of this robot's newest source packet
        """
        echoes = [(n.src_id, *n.echo) for n in self.all.values() if n.echo and n.proves and not n.silent]
        return [Heard(src_id, echo, since & 0xFFFF) for src_id, echo, since in echoes if newest - since < 1 << 16]

    def since(self, src_id: int) -> tuple[int, bool]:
        """The number that this robot had reached when it heard the newest hello of another one, and whether that one
        lacks a proof."""
        neighbour = self.all.get(src_id)
        if neighbour is None or neighbour.echo is None:
            return 0, False
        return neighbour.echo[1], neighbour.hello.capabilities & WANTS_PROOF != 0

    def check_own(self, data: bytes, header: Header) -> None:
        """Look at a packet that has this robot's own id.

        :raises SameIdError: it is a hello of another start
        """
        if header.qos != QOS_REPAIR or header.sealed != self._keys.sealed:
            return
        repair = read_repair_header(data, header.size, len(data) - self._keys.trailer_len)
        if not repair.clear:
            return
        hello, _, clear, rest = self._read_hello(data, header, repair)
        if hello.boot != self._own[1]:
            self._trailer(header.src_id, hello, clear, rest, (hello.turns << 16 | header.number, repair.repair_id))
            raise SameIdError(
                f"robot {header.src_id} is this robot, but start {hello.boot:016x} has that id too: two robots have it "
                "(give one another robot_id), or a recording of an earlier start is on the air"
            )

    def settle(self, now: float) -> None:
        """Store the exact packet number reached by robots that are quiet."""
        for neighbour in self.all.values():
            counts, exact = self._counts_on_store(neighbour.hello), neighbour.inbox.newest + 1
            self.floors.settle(neighbour.floor, exact, neighbour.heard, now, counts=counts)

    def _greets(self, data: bytes, header: Header) -> bool:
        """Whether a packet of messages that is not sealed has a hello of the start that sent it."""
        if header.sealed:
            return False
        try:
            hello, _, clear, rest = self._read_hello(data, header, None)
            self._trailer(header.src_id, hello, clear, rest, (hello.turns << 16 | header.number, NOT_A_REPAIR))
        except WireError:
            return False
        return True

    def _read_hello(
        self, data: bytes, header: Header, repair: RepairHeader | None
    ) -> tuple[Hello, list[EntryV1], bytes, bytes]:
        """A hello, all entries of its packet, and the packet before and after its body begins."""
        start = header.size + (0 if repair is None else repair.size)
        entries = read_body(data[start : len(data) - self._trailer_len], header.room(self._settings.packet_len))
        return hello_in(entries, control=repair is not None), entries, data[:start], data[start:]

    def _hello(self, data: bytes, header: Header, repair: RepairHeader | None, now: float) -> Opened:
        """Open a packet with a hello, which itself says how the packet is opened.

        :param repair: None for a packet of messages
        """
        src_id, sealed = header.src_id, self._keys.sealed
        hello, entries, clear, rest = self._read_hello(data, header, repair)
        number, repair_id = hello.turns << 16 | header.number, NOT_A_REPAIR
        after, body = number, rest[: len(rest) - self._trailer_len]
        if repair is not None:
            repair_id, after, body = repair.repair_id, number + 1, b""
        neighbour = self.all.get(src_id)
        if neighbour is not None and neighbour.boot == hello.boot:
            neighbour.trailer.open(clear, rest, number, repair_id, plain=True)
            jumps = not sealed and abs(number - neighbour.inbox.newest) > _HALF
            if not (jumps and neighbour.silent):
                if jumps or not neighbour.new(number, repair_id):
                    raise ReplayedError(f"a hello of robot {src_id} at packet {number} was here before, or cannot be")
                self.greeted(neighbour, hello, number)
                return self._opened(Opened(neighbour, header, number, repair, body, entries), now)
        boot, floor = self.floors.of(src_id)
        robot = self._robots.of(src_id)
        before = robot.met
        proven = sealed and self.own_hellos.proofs(number, entries, before)
        refused = hello.boot < boot and not proven
        if not sealed:
            refused = neighbour is not None and now < before + _CHANGE_S * self._settings.slower
        if refused:
            if number >= self._ended.get((src_id, hello.boot), _MOST):
                # No recording of what was heard: the robot of that start goes on, or what it sent then comes only now.
                self._trailer(src_id, hello, clear, rest, (number, repair_id))
                self.sent_by_another_start(src_id, hello.boot, now, now)
            newest = boot if neighbour is None else neighbour.boot
            raise ReplayedError(f"start {hello.boot:016x} of robot {src_id}, after start {newest:016x} was heard")
        trailer = self._trailer(src_id, hello, clear, rest, (number, repair_id))
        again, stores = boot == hello.boot, self._counts_on_store(hello)
        if again and stores and number < floor:
            raise ReplayedError(f"a hello of robot {src_id} from before packet {floor}, up to which it was heard")
        if neighbour is None:
            neighbour = self._place_for(src_id)
        first = 1 if number <= START and repair is not None else after
        if again:
            first = max(first, floor if stores else after)
        if neighbour is not None:
            self._ended[neighbour.src_id, neighbour.boot] = neighbour.inbox.newest + 1
            if len(self._ended) > _STARTS:
                del self._ended[next(iter(self._ended))]
        if (ended := self._ended.pop((src_id, hello.boot), None)) is not None:
            first = max(first, ended)
            self.sent_by_another_start(src_id, hello.boot, now, now)
        room = header.room(self._settings.packet_len)
        proofs, proves = Proofs(before), self._proves(hello)
        inbox = self._make_inbox(src_id, hello.boot, first, room, proofs.sealed_after if proves else None)
        met = Neighbour(
            src_id,
            hello.boot,
            trailer,
            inbox,
            hello,
            number,
            now,
            Floor(src_id, hello.boot),
            proofs,
            proves,
        )
        robot.met = now
        met.new(number, repair_id)
        self.all[src_id] = met
        self.floors.store(met.floor, max(first, number + 1) if stores else 0, now)
        opened = Opened(met, header, number, repair, body, entries, appeared=True, replaced=neighbour)
        return self._opened(opened, now)

    def greeted(self, neighbour: Neighbour, hello: Hello, number: int) -> None:
        """Note a hello of the present start of a robot, at a packet number."""
        if number >= neighbour.hello_number:
            neighbour.hello, neighbour.hello_number = hello, number
            neighbour.proves = self._proves(hello)

    def _trailer(self, src_id: int, hello: Hello, clear: bytes, rest: bytes, place: tuple[int, int]) -> Trailer:
        encrypt = hello.capabilities & ENCRYPTS != 0
        failed: WireError = WrongKeyError(f"a hello of robot {src_id} is sealed with a key that is not accepted here")
        for trailer in self._keys.candidates(src_id, hello.boot, encrypt=encrypt):
            try:
                trailer.open(clear, rest, *place, plain=True)
                return trailer
            except TagError:
                continue
            except CrcError as error:
                failed = error
        raise failed

    def _place_for(self, src_id: int) -> Neighbour | None:
        """The robot whose state is dropped for another one, if there are as many as may be."""
        if len(self.all) < self._settings.max_sources:
            return None
        quiet = min(self.all.values(), key=lambda neighbour: (not neighbour.gone, neighbour.heard))
        if not quiet.gone:
            raise SourcesError(f"robot {src_id}: {len(self.all)} others are heard; raise max_sources")
        return self.all.pop(quiet.src_id)

    def _keep(self, src_id: int, data: bytes, now: float) -> None:
        if src_id not in self._early and len(self._early) >= self._settings.max_sources:
            del self._early[next(iter(self._early))]
        self._early.setdefault(src_id, deque(maxlen=_EARLY)).append((now, data))

    def _counts_on_store(self, hello: Hello) -> bool:
        """Whether only the stored packet number keeps replays of a robot out."""
        return self._stores and not self._proves(hello)
