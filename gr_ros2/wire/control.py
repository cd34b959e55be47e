"""Entries of version 1 that are not messages: hellos, requests, reports, and what tries out a link.

Invariant: an entry begins with its kind and its length, one byte each, so that a decoder can skip unknown entries.
"""

from __future__ import annotations

from struct import Struct
from struct import error as struct_error
from typing import NamedTuple

from gr_ros2.core.errors import EncodeError, EntryBoundsError, EntryKindError
from gr_ros2.wire.ages import age_in_words, age_of

_LEFT_OUT, _WAITED, _HELLO, _ASK, _REPORT, _HEARD, _PING, _ABOUT, _NEWEST = range(0xF6, 0xFF)

_heard = Struct(">B4sH")
_hello = Struct(">QIBI")
_mark = Struct(">BI")
_report = Struct(">BHHQB")
_ping = Struct(">BHBHHQB")
_about = Struct(">HII")
_newest, _whole = Struct(">BBBH"), Struct(">BBBIB")
_left_out = Struct(">HQB")
_REPLY, _WANTS_ABOUT = 1, 2
_UNKNOWN_SNR = 255
_LEAST_SNR_DB, _MOST_SNR_DB, _SNR_STEPS = -40, 60, 2
"""Range of a reported SNR, dB, and its steps per dB."""
HELLO_LEN = 2 + _hello.size
MARK_LEN = _mark.size
MAP = 64
"""Number of packets that a report covers."""
REPORT_LEN = 2 + _report.size
"""Bytes of a report without SNR. With it, a report has one more."""
HEARD_LEN = 2 + _heard.size
PING_LEN = 2 + _ping.size
ABOUT_LEN = 2 + _about.size
"""Bytes without its text."""
NEWEST_LEN, WHOLE_LEN = 2 + _newest.size, 2 + _whole.size
"""Bytes of the newest message of a topic, and of one up to which all are there."""
WAITED_LEN = 2
"""Bytes beside the ages."""
LEFT_OUT_LEN = 2 + _left_out.size
HELD_STEP_S = 1e-4
ECHO_LEN = 4


class Hello(NamedTuple):
    """Announces a robot.

    :param boot: number of this start of the robot, 0..2^64-1: a number greater than those of all earlier ones, and 32
        random bits
    :param turns: how often the 16-bit packet number has wrapped around, 0..2^32-1
    :param capabilities: ``CAN_HEAR``, ``ENCRYPTS``, ``REPORTED``, ``WANTS_PROOF`` and ``READS_LEFT_OUT``; other bits
        are ignored
    :param digest: sum of the marks of the rows in the robot's table of topics, 0 if it has none
    :param marks: (topic id, CRC-32 of the message as transmitted) of messages kept for robots that join late
    """

    boot: int
    turns: int
    capabilities: int
    digest: int
    marks: tuple[tuple[int, int], ...] = ()

    def describe(self) -> str:
        words = [f"hello, boot {self.boot >> 32}.{self.boot & 0xFFFF_FFFF:08x}, turns {self.turns}"]
        words += ["hears and reports"] * (self.capabilities & CAN_HEAR != 0)
        words += ["encrypts"] * (self.capabilities & ENCRYPTS != 0)
        words += ["is reported to"] * (self.capabilities & REPORTED != 0)
        words += ["wants proof"] * (self.capabilities & WANTS_PROOF != 0)
        words += ["reads what is left out"] * (self.capabilities & READS_LEFT_OUT != 0)
        words += [f"table {self.digest:08x}"] * (self.digest != 0)
        words += [f"keeps topic {topic_id} {mark:08x}" for topic_id, mark in self.marks]
        return ", ".join(words)


CAN_HEAR = 1
"""The robot receives too, and reports what it hears."""
ENCRYPTS = 2
"""Bodies of the robot's packets are encrypted; without this bit, sealed packets are only authenticated."""
REPORTED = 4
"""Robots report to this one what they hear: it repairs what they lack, or says that it does not."""
WANTS_PROOF = 8
"""The robot hears another one that has not proven yet that it heard this start: who hears this answers with a hello."""

READS_LEFT_OUT = 16
"""The robot reads :class:`LeftOut`: packets may be sent that it cannot hear."""


class Ask(NamedTuple):
    """A request for messages kept for robots that join late.

    :param src_id: the robot that keeps the messages
    :param topic_ids: the topics, 240 for the table
    """

    src_id: int
    topic_ids: bytes

    def describe(self) -> str:
        return f"ask, of robot {self.src_id} topics {' '.join(map(str, self.topic_ids))}"


class Report(NamedTuple):
    """Which packets of one robot arrived.

    :param src_id: the robot whose packets are reported
    :param boot: the low 16 bits of that robot's boot number
    :param number: newest number that the map covers, mod 2^16
    :param arrived: bit i says that packet ``number - i`` is here, 64 bits
    :param settled: no packet older than the map is needed
    :param loss: recent share of packets lost, 0..127 in 1/128
    :param snr_db: SNR of the newest packets that arrived, -40..60 dB in steps of 0.5; None where it is not measured
    """

    src_id: int
    boot: int
    number: int
    arrived: int
    settled: bool
    loss: int
    snr_db: float | None = None

    def describe(self) -> str:
        older = ", nothing older wanted" if self.settled else ""
        return (
            f"report, of robot {self.src_id} (boot ends in {self.boot:04x}), number {self.number}, "
            f"arrived {self.arrived:016x}{older}, loss {self.loss / 128:.0%}"
            + ("" if self.snr_db is None else f", SNR {self.snr_db:g} dB")
        )


class Heard(NamedTuple):
    """The sender has heard a hello of another robot. This proves to that robot that the sender's packets with a number
    above ``since`` were sealed after that hello.

    :param src_id: id of the other robot
    :param echo: the last ``ECHO_LEN`` bytes of that hello's packet
    :param since: number of the sender's newest source packet when the hello came, mod 2^16
    """

    src_id: int
    echo: bytes
    since: int

    def describe(self) -> str:
        return f"heard, robot {self.src_id}, its hello that ends in {self.echo.hex()}, after number {self.since}"


class Ping(NamedTuple):
    """A question to a robot that answers at once, or the answer.

    :param robot: the robot that is asked; in an answer, the robot that asked
    :param number: of the question, mod 2^16
    :param reply: whether this is the answer
    :param wants_about: whether the answer should come with an ``About``
    :param arrived: in an answer: questions that have come from this robot, mod 2^16
    :param held: in an answer: time from the question's arrival to the answer's leaving, in ``HELD_STEP_S``, 0..65535
    :param clock_us: the sender's clock as this leaves, us since 1970; 0 = it has none
    :param snr_db: in an answer: SNR of the packets of the robot that asked, dB; None where it is not measured
    """

    robot: int
    number: int
    reply: bool = False
    wants_about: bool = False
    arrived: int = 0
    held: int = 0
    clock_us: int = 0
    snr_db: float | None = None

    def describe(self) -> str:
        if not self.reply:
            return f"ping, number {self.number} to robot {self.robot}" + ", asks what it is" * self.wants_about
        snr = "" if self.snr_db is None else f", SNR {self.snr_db:g} dB"
        return (
            f"pong, number {self.number} to robot {self.robot}, {self.arrived} have come, "
            f"held for {self.held * HELD_STEP_S * 1e3:.1f} ms{snr}"
        )


class About(NamedTuple):
    """What a robot's end of the link is, so that another end can tell what does not match.

    :param packet_len: its longest packet, bytes
    :param phy: CRC-32 of the settings of its PHY
    :param key: first 4 bytes of the SHA-256 of its key, 0 without one
    :param text: version of the program and whatever else people want to know; UTF-8
    """

    packet_len: int
    phy: int
    key: int
    text: bytes = b""

    def describe(self) -> str:
        text = self.text.decode("utf-8", "replace")
        return f"about, packets of {self.packet_len} bytes, phy {self.phy:08x}, key {self.key:08x}, {text!r}"


class Newest(NamedTuple):
    """The newest message that the sender has of a topic of another robot, where messages are relayed; of a reliable
    topic for all robots the newest up to which all are there.

    :param origin: the robot whose topic it is
    :param start: the low 8 bits of that robot's boot number
    :param topic_id: in that robot's table
    :param number: of that robot's packet in which the message began, mod 2^16; mod 2^32 with a place
    :param place: of a message of a reliable topic among the entries there, 255 for all; None for other topics
    """

    origin: int
    start: int
    topic_id: int
    number: int
    place: int | None = None

    def describe(self) -> str:
        return (
            f"newest, of robot {self.origin} (boot ends in {self.start:02x}) topic {self.topic_id}, "
            f"from its packet {self.number}" + ("" if self.place is None else f".{self.place}, and all before it")
        )


class Waited(NamedTuple):
    """For how long messages that begin in this packet have waited at the robot that made them.

    :param ages: of the messages and fragments of the packet, in their order, the code of how long each has waited; 0
        where that is not told, as of all behind the last one
    """

    ages: bytes

    def age_s(self, place: int) -> float:
        """How long the message at a place among the entries has waited, s; infinite for longer than can be told."""
        return age_of(self.ages[place]) if place < len(self.ages) else 0.0

    def describe(self) -> str:
        told = [f"entry {place} for {age_in_words(code)}" for place, code in enumerate(self.ages) if code]
        return f"waited, {', '.join(told)}" if told else "waited, none"


class LeftOut(NamedTuple):
    """Packets of the sender for which no message waits: they were sent so that not all robots hear them, and carry
    nothing that is delivered in order, or they are not repaired any more.

    :param number: newest number that the map covers, mod 2^16
    :param packets: bit i says that packet ``number - i`` is one of them, 64 bits
    :param settled: nor does any message wait for a packet older than the map
    """

    number: int
    packets: int
    settled: bool

    def describe(self) -> str:
        older = ", nothing older repaired" if self.settled else ""
        return f"left out, number {self.number}, packets {self.packets:016x}{older}"


def length_of(newest: Newest) -> int:
    """Bytes of an entry."""
    return NEWEST_LEN if newest.place is None else WHOLE_LEN


Control = Hello | Ask | Report | Heard | Ping | About | Newest | Waited | LeftOut


def reportable(snr_db: float) -> float:
    """An SNR as a report can tell it."""
    return min(max(round(snr_db * _SNR_STEPS) / _SNR_STEPS, _LEAST_SNR_DB), _MOST_SNR_DB)


def write_control(entry: Control) -> bytes:
    """The bytes of an entry.

    :raises EncodeError: a field out of range
    """
    try:
        if isinstance(entry, Report):
            source, boot, number, arrived, settled, loss, snr_db = entry
            if not 0 <= loss < 128:
                raise EncodeError(f"loss {loss} of a report is not in 0..127")
            name, data = _REPORT, _report.pack(source, boot, number, arrived, settled << 7 | loss)
            if snr_db is not None:
                data += bytes((_snr_byte(snr_db),))
        elif isinstance(entry, Hello):
            marks = b"".join(_mark.pack(*mark) for mark in entry.marks)
            name, data = _HELLO, _hello.pack(*entry[:4]) + marks
        elif isinstance(entry, Heard):
            if len(entry.echo) != ECHO_LEN:
                raise EncodeError(f"{entry}: an echo has {ECHO_LEN} bytes")
            name, data = _HEARD, _heard.pack(*entry)
        elif isinstance(entry, Ping):
            robot, number, reply, wants_about, arrived, held, clock_us, snr_db = entry
            flags = _REPLY * reply | _WANTS_ABOUT * wants_about
            snr = _UNKNOWN_SNR if snr_db is None else _snr_byte(snr_db)
            name, data = _PING, _ping.pack(robot, number, flags, arrived, held, clock_us, snr)
        elif isinstance(entry, Newest):
            name, data = _NEWEST, _newest.pack(*entry[:4]) if entry.place is None else _whole.pack(*entry)
        elif isinstance(entry, Waited):
            if not entry.ages:
                raise EncodeError(f"{entry}: it tells of no message")
            name, data = _WAITED, entry.ages
        elif isinstance(entry, LeftOut):
            name, data = _LEFT_OUT, _left_out.pack(*entry)
        elif isinstance(entry, About):
            name, data = _ABOUT, _about.pack(*entry[:3]) + entry.text
        else:
            name, data = _ASK, bytes((entry.src_id,)) + entry.topic_ids
        return bytes((name, len(data))) + data
    except (struct_error, ValueError) as error:
        raise EncodeError(f"a field of {entry} is out of range ({error})") from error


def _snr_byte(snr_db: float) -> int:
    if not _LEAST_SNR_DB <= snr_db <= _MOST_SNR_DB:
        raise EncodeError(f"SNR {snr_db} dB is not in {_LEAST_SNR_DB}..{_MOST_SNR_DB}")
    return round((snr_db - _LEAST_SNR_DB) * _SNR_STEPS)


def _snr_db(byte: int) -> float:
    snr_db = _LEAST_SNR_DB + byte / _SNR_STEPS
    if snr_db > _MOST_SNR_DB:
        raise EntryKindError(f"an SNR of {snr_db:g} dB")
    return snr_db


def read_control(body: bytes, position: int, end: int) -> tuple[int, Control | None]:
    """Where the entry after the one at ``position`` begins, and the entry itself; None for an unknown kind.

    :raises EntryBoundsError: it runs past ``end``, or its length is not a multiple of the size of its items
    :raises EntryKindError: an SNR out of range
    """
    name = body[position]
    start = position + 2
    if start > end or start + body[position + 1] > end:
        raise EntryBoundsError(f"a control entry runs past byte {end}")
    stop = start + body[position + 1]
    size = stop - start
    if name == _REPORT:
        if size not in (_report.size, _report.size + 1):
            raise EntryBoundsError(f"a report of {size} bytes")
        source, boot, number, arrived, tail = _report.unpack_from(body, start)
        snr_db = _snr_db(body[stop - 1]) if size > _report.size else None
        return stop, Report(source, boot, number, arrived, tail > 127, tail & 127, snr_db)
    if name == _HELLO:
        if size < _hello.size or (size - _hello.size) % _mark.size:
            raise EntryBoundsError(f"a hello of {size} bytes")
        marks = tuple(_mark.iter_unpack(body[start + _hello.size : stop]))
        boot, turns, capabilities, digest = _hello.unpack_from(body, start)
        return stop, Hello(boot, turns, capabilities, digest, marks)
    if name == _HEARD:
        if size != _heard.size:
            raise EntryBoundsError(f"a note of {size} bytes that a robot was heard")
        return stop, Heard(*_heard.unpack_from(body, start))
    if name == _ASK:
        if size < 2:
            raise EntryBoundsError(f"a request of {size} bytes")
        return stop, Ask(body[start], body[start + 1 : stop])
    return stop, _read_exchange(name, body, start, stop)


def _read_exchange(name: int, body: bytes, start: int, stop: int) -> Control | None:
    """An entry of kinds that robots exchange at any time; None for an unknown kind."""
    size = stop - start
    if name == _PING:
        if size != _ping.size:
            raise EntryBoundsError(f"a ping of {size} bytes")
        robot, number, flags, arrived, held, clock_us, snr = _ping.unpack_from(body, start)
        reply, wants_about = flags & _REPLY != 0, flags & _WANTS_ABOUT != 0
        snr_db = None if snr == _UNKNOWN_SNR else _snr_db(snr)
        return Ping(robot, number, reply, wants_about, arrived, held, clock_us, snr_db)
    if name == _NEWEST:
        if size not in (_newest.size, _whole.size):
            raise EntryBoundsError(f"a note of the newest message, of {size} bytes")
        return Newest(*(_newest if size == _newest.size else _whole).unpack_from(body, start))
    if name == _WAITED:
        if not size:
            raise EntryBoundsError("a note of how long messages have waited, of no bytes")
        return Waited(body[start:stop])
    if name == _LEFT_OUT:
        if size != _left_out.size:
            raise EntryBoundsError(f"a note of packets left out, of {size} bytes")
        number, packets, settled = _left_out.unpack_from(body, start)
        return LeftOut(number, packets, settled & 1 != 0)
    if name == _ABOUT:
        if size < _about.size:
            raise EntryBoundsError(f"an about of {size} bytes")
        packet_len, phy, key = _about.unpack_from(body, start)
        return About(packet_len, phy, key, body[start + _about.size : stop])
    return None
