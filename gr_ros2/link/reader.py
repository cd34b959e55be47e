"""Decodes packets of version 1 for an observer: a capture, a log, a line of hex.

A receiver learns some facts from the packets it receives over time. A reader is given them beforehand: the hellos,
without which no trailer can be checked, and the keys of the fleet. Where it cannot check or open a packet, it says so
and shows the part that is not encrypted.

Invariants: ``read`` raises nothing but a named WireError; a packet that it reports as checked belongs to a hello that
was learned.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from gr_ros2.core.errors import CrcError, TagError, WireError, WrongKeyError
from gr_ros2.link.v1.endpoint_settings import MIN_PACKET_LEN
from gr_ros2.link.v1.reassembly import Reassembly
from gr_ros2.link.v1.sealing import NOT_A_REPAIR, Keys, Trailer
from gr_ros2.wire.control import ENCRYPTS, Hello
from gr_ros2.wire.mac_block import Block, read_block
from gr_ros2.wire.relayed import Relayed, read_carried, read_relayed
from gr_ros2.wire.table import AnnouncedTopic, read_table
from gr_ros2.wire.v1 import (
    BROADCAST,
    CARRIED_TOPIC,
    CRC_LEN,
    QOS_REPAIR,
    TABLE_TOPIC,
    TAG_LEN,
    EntryV1,
    Header,
    Part,
    RepairHeader,
    hello_in,
    read_body,
    read_header,
    read_repair_header,
)

_HALF = 1 << 15
_TABLE_BYTES = 1 << 20
_STARTS = 256
"""Starts remembered of each robot: anybody can send hellos of new ones where no key is used."""
_NO_KEY = "tag not checked: no key"


@dataclass(frozen=True, slots=True)
class Dissection:
    """What is known of a packet.

    :param number: the full packet number if it is known, otherwise its low 16 bits
    :param check: result of the trailer check, in words
    :param entries: entries of a source or control packet, as far as they can be read
    :param combined: linear combination of a repair
    :param hidden: bytes of a body that is encrypted and was not opened
    :param announced: the rows of its sender's table of topics that it completes and that were not known yet
    """

    header: Header
    number: int
    repair: RepairHeader | None
    check: str
    entries: tuple[EntryV1, ...] = ()
    combined: bytes = b""
    hidden: bytes = b""
    announced: tuple[AnnouncedTopic, ...] = ()

    @property
    def access(self) -> Block | None:
        """What the packet says about medium access."""
        return read_block(self.header.block)[0] if self.header.block else None

    def message(self, index: int) -> Part | None:
        """An entry, if it is a message or a fragment of one."""
        entry = self.entries[index]
        return entry if isinstance(entry, Part) else None

    def relayed(self, index: int) -> tuple[int, Relayed] | None:
        """Whose message an entry carries, if it begins one of another robot; and the robot that is to take it on, 255
        for none."""
        entry = self.message(index)
        if entry is None or entry.topic_id <= TABLE_TOPIC or entry.offset:
            return None
        try:
            if entry.topic_id == CARRIED_TOPIC:
                return read_carried(entry.payload)
            return BROADCAST, read_relayed(entry.payload)
        except WireError:
            return None


@dataclass(slots=True)
class _AnnouncedStart:
    """A start of a robot that a hello announced."""

    hello: Hello
    trailers: Sequence[Trailer]
    newest: int

    def number(self, low: int) -> int:
        """The full packet number for its low 16 bits: the one nearest to the newest; never negative."""
        number = self.newest + ((low - self.newest + _HALF) & 0xFFFF) - _HALF
        return number if number >= 0 else low


class Reader:
    """Reads packets in the order in which they arrived.

    :param packet_len: bytes of the longest packet on the link
    :param keys: 32 bytes each; empty if no sealed packet is to be opened
    :param bound: whether the packets are those of endpoints that have one radio alone, without the byte before them
    :raises ConfigError: a key of another length
    """

    def __init__(self, packet_len: int, keys: Sequence[bytes] = (), *, bound: bool = False) -> None:
        self._packet_len = max(packet_len, MIN_PACKET_LEN)
        fleet = Keys(keys, "encrypt") if keys else None
        self._keys = fleet.bound() if bound and fleet is not None else fleet
        self._starts: dict[int, list[_AnnouncedStart]] = {}
        self._current: dict[int, int] = {}
        """The boot number of each robot that is heard now, by its id."""
        self._tables: dict[int, Reassembly] = {}
        self.topics: dict[int, dict[int, AnnouncedTopic]] = {}
        """The topics that robots announced, by robot and topic id."""

    def learn(self, data: bytes) -> None:
        """Learn from a packet, whatever its position among the others, how its sender's packets are read."""
        try:
            header, repair, start, end = self._clear(data)
            if not (repair.clear if repair is not None else not header.sealed):
                return
            hello = self._hello(header, repair, data[start:end])
            repair_id = NOT_A_REPAIR if repair is None else repair.repair_id
            trailers, _ = self._check_hello(header, hello, data, start, repair_id)
        except WireError:
            return
        starts = self._starts.setdefault(header.src_id, [])
        if all(known.hello.boot != hello.boot for known in starts):
            starts.append(_AnnouncedStart(hello, trailers, _number(header, hello)))
        if len(starts) > _STARTS:
            del starts[0]
            self._current[header.src_id] = max(self._current.get(header.src_id, 0) - 1, 0)

    def read(self, data: bytes) -> Dissection:
        """Read one packet.

        :raises WireError: the bytes are not a packet, or its trailer does not belong to it
        """
        header, repair, start, end = self._clear(data)
        if repair is not None and repair.clear:
            hello = self._hello(header, repair, data[start:end])
            number, body = _number(header, hello), data[start:end]
            _, check = self._check_hello(header, hello, data, start, repair.repair_id)
            self._heard(header.src_id, hello.boot, number)
        else:
            number, opened, check = self._open(data, header, repair, start, end)
            if opened is None:
                return Dissection(header, number, repair, check, hidden=data[start:end])
            body = opened
        if repair is not None and repair.mask:
            return Dissection(header, number, repair, check, combined=body)
        entries = tuple(read_body(body, self._room(header)))
        return Dissection(
            header, number, repair, check, entries, announced=self._announced(header.src_id, number, entries)
        )

    def _clear(self, data: bytes) -> tuple[Header, RepairHeader | None, int, int]:
        """Header and other fields before the body, and where the body begins and ends."""
        header = read_header(data, self._packet_len)
        start, end = header.size, len(data) - (TAG_LEN if header.sealed else CRC_LEN)
        if header.qos != QOS_REPAIR:
            return header, None, start, end
        repair = read_repair_header(data, start, end)
        return header, repair, start + repair.size, end

    def _room(self, header: Header) -> int:
        return header.room(self._packet_len)

    def _hello(self, header: Header, repair: RepairHeader | None, body: bytes) -> Hello:
        return hello_in(read_body(body, self._room(header)), control=repair is not None)

    def _check_hello(
        self, header: Header, hello: Hello, data: bytes, start: int, repair_id: int
    ) -> tuple[list[Trailer], str]:
        """The trailer that opens the packets of a start, and the result of checking the hello's trailer, in words."""
        if header.sealed and self._keys is None:
            return [], _NO_KEY
        number = _number(header, hello)
        encrypt = hello.capabilities & ENCRYPTS != 0
        keys = self._keys if header.sealed and self._keys is not None else Keys()
        failed: WireError = WrongKeyError(
            f"a hello of robot {header.src_id}, sealed with none of these keys, or damaged"
        )
        for trailer in keys.candidates(header.src_id, hello.boot, encrypt=encrypt):
            try:
                trailer.open(data[:start], data[start:], number, repair_id, plain=True)
                return [trailer], "tag ok" if header.sealed else "CRC ok"
            except TagError:
                continue
            except CrcError as error:
                failed = error
        raise failed

    def _open(
        self, data: bytes, header: Header, repair: RepairHeader | None, start: int, end: int
    ) -> tuple[int, bytes | None, str]:
        """Full packet number, body (None if it stays encrypted) and the result of the trailer check, in words."""
        src_id, repair_id = header.src_id, NOT_A_REPAIR if repair is None else repair.repair_id
        starts = self._starts.get(src_id, [])
        if not starts:
            missing = f"no hello of robot {src_id} among these packets"
            if header.sealed:
                return header.number, None, f"not opened: {missing}"
            return header.number, data[start:end], f"CRC not checked: {missing}"
        current = self._current.get(src_id, 0)
        failed: WireError | None = None
        for at in (*range(current, len(starts)), *range(current)):
            number = starts[at].number(header.number)
            for trailer in starts[at].trailers:
                try:
                    body = trailer.open(data[:start], data[start:], number, repair_id)
                except (CrcError, TagError) as error:
                    failed = failed or error
                    continue
                self._heard(src_id, starts[at].hello.boot, number)
                return number, body, "tag ok" if header.sealed else "CRC ok"
        if failed is not None:
            raise failed
        number = starts[current].number(header.number)
        encrypted = starts[current].hello.capabilities & ENCRYPTS
        return number, None if encrypted else data[start:end], _NO_KEY

    def _heard(self, src_id: int, boot: int, number: int) -> None:
        for at, known in enumerate(self._starts.get(src_id, ())):
            if known.hello.boot == boot:
                self._current[src_id] = at
                known.newest = max(known.newest, number)

    def _announced(self, src_id: int, number: int, entries: Sequence[EntryV1]) -> tuple[AnnouncedTopic, ...]:
        """The topics that a robot has announced, if this packet completes rows that were not known yet."""
        rows: list[AnnouncedTopic] = []
        for place, part in enumerate(entries):
            if not isinstance(part, Part) or part.topic_id != TABLE_TOPIC:
                continue
            table = self._tables.setdefault(src_id, Reassembly(_TABLE_BYTES))
            whole = table.add(part, number, place, repaired=False, now=0.0)
            table.overflowing()
            payload = whole and whole.payload()
            if payload:
                rows += read_table(payload)
        topics = self.topics.setdefault(src_id, {})
        found = tuple(row for row in rows if topics.get(row.topic_id) != row)
        topics.update({row.topic_id: row for row in found})
        return found


def _number(header: Header, hello: Hello) -> int:
    """The full number at which a packet with a hello stands."""
    return hello.turns << 16 | header.number
