"""The robots that are heard: the current start of each, how its packets are opened, and which packets are refused.

A robot's packets can be opened once a hello has told its boot number. Packets that arrive shortly before the hello are
kept until then.

Where packets are sealed, the newest boot number of every robot is stored, together with a packet number below which
nothing is accepted. This number is stored before a packet above it is used. So after a restart of this robot, every
packet heard before the restart is refused. A robot that stands still (its packet number does not grow) is accepted
below that number once it says that it has heard the present start of this robot: only that robot can say so, and only
after the restart.

Where packets are not sealed, only the boot number of every robot is stored. A robot whose boot number is stored was
heard before this robot restarted, so its packets count from the first hello on, and no message comes out twice.

Invariants: no body is given out that was not opened; no standing packet is given out twice; where packets are sealed,
an older start of a robot is never accepted again.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field

from gr_ros2.errors import CrcError, EntryKindError, ReplayedError, SourcesError, TagError, WireError, WrongKeyError
from gr_ros2.link.v1.endpoint_settings import Settings
from gr_ros2.link.v1.inbox import Inbox
from gr_ros2.link.v1.repair import MAP
from gr_ros2.link.v1.sealing import SOURCE_ROW, Keys, Trailer
from gr_ros2.wire.control import ENCRYPTS, Heard, Hello
from gr_ros2.wire.v1 import (
    HEADER_LEN,
    QOS_STANDING,
    TAG_LEN,
    Entry,
    Header,
    Standing,
    body_room,
    read_body,
    read_standing,
)

Save = Callable[[int, int, int], None]
"""Stores robot id, boot number and the packet number below which nothing more is accepted. Stores before it returns."""

_HALF = 1 << 15
_EARLY = 64
"""Number of packets kept per robot that cannot be opened yet."""
_START = 64
"""If a robot is first heard within this number of packets of its start, its packets count from its start on."""
_RETREAT_S = 1.0
"""s of silence after which a robot that does not seal may return with a smaller boot number."""
_RESERVE = 16
_MOST_RESERVED = 1 << 14
_SAVING_S = 0.25


@dataclass(slots=True, eq=False)
class Neighbour:
    """One start of one robot."""

    src_id: int
    boot: int
    trailer: Trailer
    inbox: Inbox
    hello: Hello
    heard: float
    floor: int = 0
    """Stored packet number below which nothing is accepted after a restart of this robot."""
    gone: bool = False
    """Whether it has been silent for long."""
    reserve: int = _RESERVE
    saved: float = 0.0
    rows: dict[int, int] = field(default_factory=dict)
    """Rows of standing packets that carried entries, as bits, by packet number."""
    asked: dict[int, float] = field(default_factory=dict)
    """When each topic was requested."""

    @property
    def encrypts(self) -> bool:
        """Whether the bodies of its packets are encrypted."""
        return self.trailer.size == TAG_LEN and self.hello.capabilities & ENCRYPTS != 0

    def number(self, low: int) -> int:
        """The full packet number for its low 16 bits: the one nearest to the newest."""
        newest = self.inbox.newest
        number = newest + ((low - newest + _HALF) & 0xFFFF) - _HALF
        if number < 0:
            raise ReplayedError(f"packet {low} of robot {self.src_id} is older than its start")
        return number

    def fresh(self, number: int, row: int) -> None:
        """Check that a standing packet with entries is used only once.

        :raises ReplayedError: it was used before, or is too old to decide
        """
        used = self.rows.get(number, 0)
        if used >> row & 1 or number <= self.inbox.newest - MAP:
            raise ReplayedError(f"row {row} at packet {number} of robot {self.src_id} was here before")
        self.rows[number] = used | 1 << row
        if len(self.rows) > 2 * MAP:
            self.rows = {number: used for number, used in self.rows.items() if number > self.inbox.newest - MAP}


@dataclass(slots=True)
class Opened:
    """A packet whose trailer was checked.

    ``met``: it is of a start that was not known before, or of a robot that was taken for gone; ``replaced``: the robot
    start that is now forgotten, if any.
    """

    neighbour: Neighbour
    header: Header
    number: int
    standing: Standing | None
    body: bytes
    entries: list[Entry] | None = None
    met: bool = False
    replaced: Neighbour | None = None


class Neighbours:
    """All robots that are heard.

    :param own: id and boot number of this robot
    :param heard: what ``save`` has stored, by robot id: boot number and packet number
    :param inbox: makes the inbox of a start of a robot: (src_id, boot, first packet that may be needed, bytes of its
        longest body)
    """

    def __init__(
        self,
        own: tuple[int, int],
        settings: Settings,
        keys: Keys,
        *,
        heard: Mapping[int, tuple[int, int]],
        save: Save | None,
        inbox: Callable[[int, int, int, int], Inbox],
    ) -> None:
        self._own = own
        self._settings = settings
        self._keys = keys
        self._stored = dict(heard)
        self._save = save
        self._make_inbox = inbox
        self._known: dict[int, Neighbour] = {}
        self._early: dict[int, deque[bytes]] = {}

    def __iter__(self) -> Iterator[Neighbour]:
        return iter(self._known.values())

    def __len__(self) -> int:
        return len(self._known)

    def get(self, src_id: int) -> Neighbour | None:
        """A robot by its id; None if it is not known."""
        return self._known.get(src_id)

    def early(self, src_id: int) -> list[bytes]:
        """Packets of a robot that could not be opened before; they are returned once."""
        return list(self._early.pop(src_id, ()))

    def silent(self, now: float, after: float) -> list[Neighbour]:
        """Robots not heard for so many s. Their state is kept until another robot needs the room."""
        silent = [
            neighbour for neighbour in self._known.values() if neighbour.heard + after <= now and not neighbour.gone
        ]
        for neighbour in silent:
            neighbour.gone = True
        return silent

    def open(self, data: bytes, header: Header, now: float) -> Opened | None:
        """Open a packet.

        :return: None if it is kept until a hello tells how to open it
        :raises WireError: the packet cannot be opened, or must not be
        """
        start, end = header.size, len(data) - self._keys.trailer_len
        standing = None
        if header.qos == QOS_STANDING:
            standing = read_standing(data, start, end)
            if standing.clear:
                return self._hello(data, header, standing, now)
            start += standing.size
        neighbour = self._known.get(header.src_id)
        if neighbour is None:
            self._keep(header.src_id, data)
            return None
        number = neighbour.number(header.number)
        row = SOURCE_ROW if standing is None else standing.row
        try:
            body = neighbour.trailer.open(data[:start], data[start:], number, row)
        except (CrcError, TagError):
            self._keep(header.src_id, data)
            raise
        if standing is not None and not standing.mask:
            neighbour.fresh(number, row)
        met = self._heard(neighbour, number, now)
        return Opened(neighbour, header, number, standing, body, met=met)

    def settle(self, now: float) -> None:
        """Store the exact packet number reached by robots that are quiet."""
        if self._save is None or not self._keys.sealed:
            return
        for neighbour in self._known.values():
            exact = neighbour.inbox.newest + 1
            if neighbour.floor > exact and now - max(neighbour.heard, neighbour.saved) > 2 * _SAVING_S:
                neighbour.reserve = _RESERVE
                self._store(neighbour, exact, now)

    def _hello(self, data: bytes, header: Header, standing: Standing, now: float) -> Opened:
        """Open a packet with a hello, which itself says how the packet is opened."""
        src_id, start = header.src_id, header.size + standing.size
        room = body_room(self._settings.packet_len, sealed=header.sealed, addressed=header.size > HEADER_LEN)
        entries = read_body(data[start : len(data) - self._keys.trailer_len], room)
        hello = entries[0] if entries else None
        if not isinstance(hello, Hello):
            raise EntryKindError("a packet in the clear that does not begin with a hello")
        number = hello.turns << 16 | header.number
        clear, rest = data[:start], data[start:]
        neighbour = self._known.get(src_id)
        if neighbour is not None and neighbour.boot == hello.boot:
            body = neighbour.trailer.open(clear, rest, number, standing.row, plain=True)
            neighbour.fresh(number, standing.row)
            neighbour.hello = hello
            return Opened(neighbour, header, number, standing, body, entries, self._heard(neighbour, number, now))
        self._refuse_old(src_id, hello.boot, neighbour, now)
        trailer = self._trailer(src_id, hello, clear, rest, (number, standing.row))
        boot, floor = self._stored.get(src_id, (-1, 0))
        floor = floor if boot == hello.boot else 0
        if not self._keys.sealed:
            floor = number + 1 if boot == hello.boot else 0
        elif number < floor:
            if Heard(*self._own) not in entries:
                raise ReplayedError(f"a hello of robot {src_id} from before packet {floor}, up to which it was heard")
            floor = number + 1
        if neighbour is None:
            neighbour = self._room_for(src_id)
        first = max(floor, 1 if number <= _START else number + 1)
        inbox = self._make_inbox(src_id, hello.boot, first, room)
        met = Neighbour(src_id, hello.boot, trailer, inbox, hello, now)
        met.rows[number] = 1 << standing.row
        self._known[src_id] = met
        self._store(met, max(floor, number + 1) if self._keys.sealed else 0, now)
        return Opened(met, header, number, standing, b"", entries, True, neighbour)

    def _refuse_old(self, src_id: int, boot: int, neighbour: Neighbour | None, now: float) -> None:
        newest = self._stored.get(src_id, (-1, 0))[0]
        if self._keys.sealed:
            if boot < newest:
                raise ReplayedError(f"start {boot} of robot {src_id}, after start {newest} was heard")
        elif neighbour is not None and boot < neighbour.boot and now - neighbour.heard < _RETREAT_S:
            raise ReplayedError(f"start {boot} of robot {src_id}, while start {neighbour.boot} is heard")

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

    def _heard(self, neighbour: Neighbour, number: int, now: float) -> bool:
        """A packet of a known robot arrived; returns whether the robot was taken for gone."""
        neighbour.heard = now
        back, neighbour.gone = neighbour.gone, False
        self._guard(neighbour, number, now)
        return back

    def _room_for(self, src_id: int) -> Neighbour | None:
        """The robot whose state is dropped to make room for another one, if there is no more room."""
        if len(self._known) < self._settings.max_sources:
            return None
        quiet = min(self._known.values(), key=lambda neighbour: neighbour.heard)
        if not quiet.gone:
            raise SourcesError(f"robot {src_id}: {len(self._known)} others are heard; raise max_sources")
        return self._known.pop(quiet.src_id)

    def _keep(self, src_id: int, data: bytes) -> None:
        if src_id not in self._early and len(self._early) >= self._settings.max_sources:
            del self._early[next(iter(self._early))]
        self._early.setdefault(src_id, deque(maxlen=_EARLY)).append(data)

    def _guard(self, neighbour: Neighbour, number: int, now: float) -> None:
        """Store that a robot has reached this number, before the packet is used."""
        if number < neighbour.floor or self._save is None or not self._keys.sealed:
            return
        if now - neighbour.saved < _SAVING_S:
            neighbour.reserve = min(2 * neighbour.reserve, _MOST_RESERVED)
        self._store(neighbour, number + neighbour.reserve, now)

    def _store(self, neighbour: Neighbour, floor: int, now: float) -> None:
        neighbour.floor, neighbour.saved = floor, now
        self._stored[neighbour.src_id] = (neighbour.boot, floor)
        if self._save is not None:
            self._save(neighbour.src_id, neighbour.boot, floor)
