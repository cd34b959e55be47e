"""Version 1 on the wire, byte for byte; ``docs/reference/wire-format.md`` describes it.

A packet is a header, a body and a trailer. A *source* packet carries entries and has a number of its own. A *repair*
packet uses the number of a source packet; its repair id distinguishes it from other packets with this number. A
repair packet combines the bodies of source packets. One that combines none is a *control* packet: it carries hellos,
reports and requests.

Invariants: every function that reads raises nothing but a named WireError, whatever the bytes; what is written reads
back as the same values; a body does not depend on the number of its packet, so that it can be combined with others and
recovered.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from struct import Struct
from struct import error as struct_error
from typing import NamedTuple
from zlib import crc32

from gr_ros2.core.errors import (
    CrcError,
    EncodeError,
    EntryBoundsError,
    EntryKindError,
    LengthError,
    PadError,
    VarintError,
    VersionError,
    WindowError,
)
from gr_ros2.wire.control import Control, Hello, read_control, write_control
from gr_ros2.wire.format import Span, varint
from gr_ros2.wire.mac_block import MOST_LEN, block_len

VERSION = 1
BROADCAST = 255

HEADER_LEN = 4
ADDRESS_LEN = 2
"""Bytes that destination and hop count add to the header of an addressed packet."""
_ENTRY_COST = 3
"""Most bytes that an entry takes in addition to its payload, as schedulers count."""
REPAIR_HEADER_LEN = 2
"""Bytes of window and repair id. A source packet leaves as many bytes free, so that its body fits in a repair."""
CRC_LEN = 4
TAG_LEN = 8

QOS_REPAIR = 3
"""Value of the two QoS bits in packets that are not source packets."""
REPAIR_IDS = 128
"""Most repair packets at one number."""
SPAN = 30_000
"""Numbers that a sender repairs and a peer remembers, if its memory allows; numbers are mod 65,536."""
MAX_WINDOW = 127
"""Most numbers that a repair spans."""

BOUND = b"\x20"
"""Stands before each packet of an endpoint that sends over one radio of a robot alone. No packet begins with it."""

MAX_TOPICS = 240
TABLE_TOPIC = 240
"""Topic id of the table of topics (``table``), which is sent like any other message."""
RELAYED_TOPIC = 241
"""Topic id of messages of other robots (``relayed``) whose newest is worth most."""
CARRIED_TOPIC = 242
"""Topic id of messages of other robots that each robot on the way keeps until the next one has them."""
MAX_MESSAGE = 1 << 24
"""Bytes of the largest message."""
MAX_BACK = (1 << 21) - 1
"""Most packets that a message may span."""

ADDRESSED = 4
"""Bit of the first byte of a packet that is for one robot."""

_BLOCK = 0x80
_SEALED = 8
_MASKED = _CLEAR = _OLDEST = 0x80
_CODED, _FILL = 0x20, 0x10
_SHORT = 15
"""Bytes of the longest payload whose length stands in the flags; a velocity command or a clock is no longer."""
_WHOLE, _FIRST, _MIDDLE, _LAST = range(4)

_header = Struct(">BBH")
_session = Struct(">QI")


class Header(NamedTuple):
    """The header: the bytes before the body.

    :param qos: 0 default, 1 latency, 2 bulk; 3 for a packet that is not a source packet
    :param sealed: the trailer is an 8-byte tag, not a CRC-32
    :param src_id: 0..254
    :param number: number of the source packet, or the number at which a repair packet stands; mod 2^16
    :param dst_id: 0..254 in an addressed packet, otherwise 255
    :param hop: hop count of an addressed packet, 0..255
    :param block: for medium access, see :mod:`gr_ros2.wire.mac_block`; empty where a channel is not shared
    """

    qos: int
    sealed: bool
    src_id: int
    number: int
    dst_id: int = BROADCAST
    hop: int = 0
    block: bytes = b""

    @property
    def size(self) -> int:
        """Bytes on the wire, with the block."""
        size = HEADER_LEN if self.dst_id == BROADCAST else HEADER_LEN + ADDRESS_LEN
        return size + len(self.block)

    def room(self, packet_len: int) -> int:
        """Bytes of the longest body behind such a header."""
        return body_room(packet_len, sealed=self.sealed, addressed=self.dst_id != BROADCAST, block=bool(self.block))


class Part(NamedTuple):
    """A message, or a fragment of one.

    :param topic_id: 0..239, 240 for the table of topics, 241 and 242 for messages of other robots
    :param payload: these bytes of the message
    :param back: how many source packets ago the message began; of one that is sent again, when it was first sent
    :param offset: where in the message the payload stands, bytes
    :param last: whether the message ends with it
    :param coded: whether the message is coded (compressed); its first byte then says how
    """

    topic_id: int
    payload: bytes
    back: int = 0
    offset: int = 0
    last: bool = True
    coded: bool = False

    @property
    def name(self) -> int:
        """``back``. Together with its packet's number, it identifies the message."""
        return self.back

    @property
    def whole(self) -> bool:
        """Whether it is a message, and no fragment."""
        return self.last and not (self.offset or self.back)

    @property
    def label(self) -> str:
        """``[whole]``, or ``-back[offset..end)``; ``]`` instead of ``)`` where the message ends."""
        if self.whole:
            return "[whole]"
        return f"-{self.back}[{self.offset}..{self.offset + len(self.payload)}{']' if self.last else ')'}"

    def describe(self) -> str:
        if self.whole:
            return "whole"
        end = ", its last" if self.last else ""
        return f"began {self.back} packets ago, bytes from {self.offset} on{end}"


EntryV1 = Part | Control


class RepairHeader(NamedTuple):
    """The fields after the header of a packet that is not a source packet.

    :param repair_id: 0..127; number and repair id together identify the packet
    :param mask: bit i says that source packet ``number - i`` is part of the combination; 0 in a control packet
    :param oldest: no packet older than the window is repaired any more; in a control packet none up to its number
    :param clear: the entries are not encrypted (as in a hello, without which nothing could be decrypted)
    :param size: bytes on the wire
    """

    repair_id: int
    mask: int = 0
    oldest: bool = False
    clear: bool = False
    size: int = REPAIR_HEADER_LEN


def session_crc(boot: int, turns: int) -> int:
    """The CRC-32 over the session, which a packet does not carry; ``crc`` continues from it.

    :param boot: boot number of the sender
    :param turns: how often its packet number has wrapped around
    """
    return crc32(_session.pack(boot, turns))


def crc(data: bytes, session: int) -> bytes:
    """CRC-32 (IEEE 802.3, the one of zlib) over boot number, turns and packet, big-endian."""
    return crc32(data, session).to_bytes(CRC_LEN, "big")


def is_sealed(data: bytes) -> bool:
    """Whether a packet's header says that a key seals it."""
    data = data.removeprefix(BOUND)
    return len(data) > HEADER_LEN and data[0] >> 4 & 7 == VERSION and data[0] & _SEALED != 0


@lru_cache(64)
def body_room(packet_len: int, *, sealed: bool = False, addressed: bool = False, block: bool = False) -> int:
    """Bytes of the longest body of a source packet, whatever the length of its block for medium access."""
    used = HEADER_LEN + addressed * ADDRESS_LEN + REPAIR_HEADER_LEN + (TAG_LEN if sealed else CRC_LEN)
    room = packet_len - used - block * MOST_LEN
    return room if room > 0 else 0


def write_header(header: Header) -> bytes:
    """The 4 or 6 bytes of a header, and the block behind it.

    :raises EncodeError: for a field out of range
    """
    qos, sealed, src_id, number, dst_id, hop, block = header
    addressed = dst_id != BROADCAST
    try:
        if not 0 <= qos <= QOS_REPAIR or not 0 <= src_id < BROADCAST:
            raise EncodeError(f"qos {qos} or src_id {src_id} of {header} is out of range")
        first = bool(block) * _BLOCK | VERSION << 4 | sealed * _SEALED | addressed * ADDRESSED | qos
        data = _header.pack(first, src_id, number)
        return data + bytes((dst_id, hop)) + block if addressed else data + block
    except (struct_error, ValueError) as error:
        raise EncodeError(f"a field of {header} is out of range ({error})") from error


def read_header(data: bytes, packet_len: int) -> Header:
    """The header of a packet of at most ``packet_len`` bytes; nothing after it is checked.

    :raises LengthError: too long, or too short for header and trailer
    :raises VersionError: not version 1
    :raises EntryBoundsError: its block for medium access runs into the trailer
    """
    size = len(data)
    if size > packet_len or size < HEADER_LEN + CRC_LEN:
        raise LengthError(f"{size} bytes where packet_len is {packet_len}")
    first, src_id, number = _header.unpack_from(data)
    if first >> 4 & 7 != VERSION:
        raise VersionError(f"version {first >> 4 & 7}; this decoder reads version {VERSION}")
    if first & (_BLOCK | _SEALED | ADDRESSED):
        start = HEADER_LEN + ADDRESS_LEN if first & ADDRESSED else HEADER_LEN
        end = size - (TAG_LEN if first & _SEALED else CRC_LEN)
        if start > end:
            raise LengthError(f"{size} bytes; a packet of this kind has at least {size + start - end}")
        to = (data[4], data[5]) if first & ADDRESSED else (BROADCAST, 0)
        block = data[start : start + block_len(data, start, end)] if first & _BLOCK else b""
        return Header(first & 3, first & _SEALED != 0, src_id, number, *to, block)
    return Header(first & 3, first & _SEALED != 0, src_id, number)


def write_repair_header(repair: RepairHeader) -> bytes:
    """The bytes of window, repair id and mask. A mask is written if the combination leaves out packets of its window.

    :raises EncodeError: for a field out of range
    """
    repair_id, mask, oldest, clear, _ = repair
    window = mask.bit_length()
    if not 0 <= repair_id < REPAIR_IDS or mask < 0 or window > MAX_WINDOW or (mask and (clear or not mask & 1)):
        raise EncodeError(f"{repair}: a repair id is 0..127, a mask has up to 127 bits and the lowest set")
    second = repair_id | oldest * _OLDEST
    if not mask:
        return bytes((clear * _CLEAR, second))
    if mask + 1 == 1 << window:
        return bytes((window, second))
    return bytes((window | _MASKED, second)) + mask.to_bytes((window + 7) // 8, "little")


def read_repair_header(data: bytes, start: int, end: int) -> RepairHeader:
    """Window, repair id and mask from byte ``start`` of a packet whose trailer begins at ``end``.

    :raises EntryBoundsError: they run into the trailer
    :raises WindowError: bits that contradict each other
    """
    if start + REPAIR_HEADER_LEN > end:
        raise EntryBoundsError(f"window and repair id run past byte {end}")
    window, repair_id = data[start] & 127, data[start + 1] & 127
    flag, oldest = data[start] & _MASKED, data[start + 1] & _OLDEST != 0
    if not window:
        return RepairHeader(repair_id, 0, oldest, flag != 0)
    if not flag:
        return RepairHeader(repair_id, (1 << window) - 1, oldest)
    size = REPAIR_HEADER_LEN + (window + 7) // 8
    if start + size > end:
        raise EntryBoundsError(f"the mask of {window} numbers runs past byte {end}")
    mask = int.from_bytes(data[start + REPAIR_HEADER_LEN : start + size], "little")
    if not mask & 1 or mask.bit_length() != window or mask + 1 == 1 << window:
        raise WindowError(f"mask {mask:#x} does not begin and end a window of {window}, or leaves nothing out")
    return RepairHeader(repair_id, mask, oldest, False, size)


def fit(room: int, remaining: int, back: int, offset: int) -> tuple[int, int]:
    """How much of a message fits into the free bytes of a body.

    :param room: bytes free
    :param remaining: bytes of the message not yet sent
    :param back: source packets since it began, 0 where it begins
    :param offset: bytes of it already sent
    :return: bytes of payload (-1 if nothing fits) and bytes of the entry. A fragment that is not the last one fills the
        body.
    """
    head = 2 + (_varint_len(back) + _varint_len(offset) if offset or back else 0)
    if remaining < room - head:
        return remaining, head + (not 0 < remaining <= _SHORT) + remaining
    most = min(room - head, remaining)
    if most < 0 or (not most and remaining):
        return -1, 0
    return most, head + most


def write_body(entries: Sequence[EntryV1], room: int) -> bytes:
    """The bytes of some entries, without padding.

    :param room: bytes of the longest body; if the last entry ends there, it leaves out its length where possible
    :raises EncodeError: a field out of range, or more bytes than ``room``
    """
    body = b""
    for entry in entries:
        body += _write_part(entry, room - len(body)) if isinstance(entry, Part) else write_control(entry)
    if len(body) > room:
        raise EncodeError(f"{len(body)} bytes of entries do not fit a body of {room}")
    return body


def read_body(body: bytes, room: int) -> list[EntryV1]:
    """The entries of a body. Zeros may follow them; entries of unknown kinds are left out.

    :param room: the longest body on this link
    :raises WireError: EntryBoundsError, EntryKindError, VarintError or PadError
    """
    entries: list[EntryV1] = []
    position, end = 0, min(len(body), room)
    while position < end:
        name = body[position]
        if not name:
            break
        if name > CARRIED_TOPIC + 1:
            position, control = read_control(body, position, end)
            if control is not None:
                entries.append(control)
            continue
        if position + 2 > end:
            raise EntryBoundsError(f"the header of an entry runs past byte {end}")
        flags = body[position + 1]
        position += 2
        if flags & _FILL:
            length = flags & 15 or -1
            if length < 0 and len(body) < room:
                raise EntryKindError(f"an entry that fills its body, in a body of {len(body)} of {room} bytes")
        else:
            if position >= end:
                raise EntryBoundsError(f"the header of an entry runs past byte {end}")
            length = (flags & 15) << 8 | body[position]
            position += 1
        kind = flags >> 6
        back = offset = 0
        if kind >= _MIDDLE:
            back, position = read_varint(body, position, end)
            offset, position = read_varint(body, position, end)
            if not (offset or back):
                raise EntryKindError("a later fragment at the begin of its message")
        stop = end if length < 0 else position + length
        if stop > end or position > stop:
            raise EntryBoundsError(f"an entry of {length} bytes runs past byte {end}")
        if kind and stop == position:
            raise EntryKindError("a fragment of no bytes")
        if back > MAX_BACK or offset + stop - position > MAX_MESSAGE:
            raise VarintError(f"a fragment {back} packets and {offset} bytes after the begin of its message")
        coded = flags & _CODED != 0
        entries.append(Part(name - 1, body[position:stop], back, offset, not kind or kind == _LAST, coded))
        position = stop
    if body.count(0, position) != len(body) - position:
        raise PadError(f"bytes from {position} on are not all zero")
    return entries


def hello_in(entries: Sequence[EntryV1], *, control: bool) -> Hello:
    """The hello that may have an effect: the first entry of a control packet, or any of a packet of messages.

    :raises EntryKindError: there is none
    """
    for entry in entries[:1] if control else entries:
        if isinstance(entry, Hello):
            return entry
    raise EntryKindError("a packet in the clear that does not begin with a hello")


def _write_part(part: Part, room: int) -> bytes:
    topic_id, payload, back, offset, last, coded = part
    size = len(payload)
    later = offset or back
    kind = (_LAST if last else _MIDDLE) if later else (_WHOLE if last else _FIRST)
    if not 0 <= topic_id <= CARRIED_TOPIC:
        raise EncodeError(f"topic id {topic_id} is not in 0..{CARRIED_TOPIC}")
    if not 0 <= offset <= MAX_MESSAGE - size or not 0 <= back <= MAX_BACK:
        raise EncodeError(f"a fragment {back} packets and {offset} bytes after the begin of its message, {size} long")
    if kind and not size:
        raise EncodeError("a fragment has at least one byte")
    place = varint(back) + varint(offset) if later else b""
    flags = kind << 6 | coded * _CODED
    if 2 + len(place) + size == room:
        return bytes((topic_id + 1, flags | _FILL)) + place + payload
    if 0 < size <= _SHORT:
        return bytes((topic_id + 1, flags | _FILL | size)) + place + payload
    if size > 0xFFF:
        raise EncodeError(f"an entry of {size} bytes")
    return bytes((topic_id + 1, flags | size >> 8, size & 255)) + place + payload


def _varint_len(value: int) -> int:
    return 1 if value < 128 else (value.bit_length() + 6) // 7


def read_varint(body: bytes, position: int, end: int) -> tuple[int, int]:
    """The number at a position, and the position behind it.

    :raises VarintError: it has more bytes than it needs, or than 4
    :raises EntryBoundsError: it runs past ``end``
    """
    value = shift = 0
    while position < end:
        byte = body[position]
        position += 1
        value |= (byte & 127) << shift
        if byte < 128:
            if not byte and shift:
                raise VarintError("a number with more bytes than it needs")
            return value, position
        shift += 7
        if shift > 21:
            raise VarintError("a number of more than 4 bytes")
    raise EntryBoundsError(f"a number runs past byte {end}")


class PacketV1(NamedTuple):
    """A packet as a value.

    :param body: entries of a source or control packet, as far as they can be read
    :param repair: the fields of a repair or control packet
    :param combined: the combination in a repair, as long as the longest body that it combines
    :param encrypted: whether the body was encrypted
    """

    header: Header
    body: tuple[EntryV1, ...] = ()
    repair: RepairHeader | None = None
    combined: bytes = b""
    encrypted: bool = False

    @property
    def version(self) -> int:
        return VERSION

    @property
    def src_id(self) -> int:
        return self.header.src_id

    @property
    def dst_id(self) -> int:
        return self.header.dst_id

    @property
    def seq(self) -> int:
        """Number of the source packet, or the number at which a repair packet stands, mod 2^16."""
        return self.header.number

    @property
    def numbered(self) -> bool:
        """Whether it is a source packet. A repair or a control packet stands at the newest source packet's number."""
        return self.repair is None

    @property
    def qos(self) -> int:
        """QoS class of its messages; default if it carries none."""
        return self.header.qos if self.repair is None else 0

    @property
    def hop(self) -> int:
        return self.header.hop

    @property
    def compressed(self) -> bool:
        """Whether any of its messages is coded."""
        return any(entry.coded for entry in self.entries)

    @property
    def entries(self) -> tuple[Part, ...]:
        return tuple([entry for entry in self.body if isinstance(entry, Part)])


def encode(packet: PacketV1, packet_len: int, boot: int, turns: int = 0, *, fixed: bool = True) -> bytes:
    """The bytes of a packet that is not sealed.

    :param packet_len: bytes of the longest packet on this link
    :param fixed: whether every packet has ``packet_len`` bytes; otherwise it has only as many as needed
    :raises EncodeError: a field out of range, or more than fits
    """
    header, entries, repair, combined, _ = packet
    if header.sealed or (repair is None) == (header.qos == QOS_REPAIR):
        raise EncodeError(f"{header}: a sealed packet, or a repair packet without its window and repair id")
    room = header.room(packet_len)
    data = write_header(header)
    if repair is not None:
        data += write_repair_header(repair)
    data += combined if repair is not None and repair.mask else write_body(entries, room)
    full = packet_len - CRC_LEN
    if len(data) > full:
        raise EncodeError(f"{len(data) + CRC_LEN} bytes do not fit packet_len {packet_len}")
    data = data.ljust(full, b"\0") if fixed else data
    return data + crc(data, session_crc(boot, turns))


def decode(data: bytes, packet_len: int, boot: int | None = None, turns: int = 0) -> PacketV1:
    """Read a packet.

    :param packet_len: bytes of the longest packet on this link
    :param boot: boot number of the sender, from its hello, for a packet that is not sealed; None: it is not known. Then
        the trailer is checked only if the packet itself carries that hello, and of a sealed packet only a hello is read
    :raises WireError: LengthError, VersionError, CrcError, WindowError, EntryBoundsError, EntryKindError, VarintError
        or PadError
    """
    header = read_header(data, packet_len)
    start, end = header.size, len(data) - (TAG_LEN if header.sealed else CRC_LEN)
    if boot is not None and (header.sealed or crc(data[:end], session_crc(boot, turns)) != data[end:]):
        raise CrcError("CRC-32 does not match, or the packet is sealed")
    repair = None
    if header.qos == QOS_REPAIR:
        repair = read_repair_header(data, start, end)
        start += repair.size
    clear = repair is not None and repair.clear
    if header.sealed and not clear:
        return PacketV1(header, (), repair, b"", encrypted=True)
    if repair is not None and repair.mask:
        return PacketV1(header, (), repair, data[start:end])
    body = tuple(read_body(data[start:end], header.room(packet_len)))
    if boot is None and clear and not header.sealed:
        hello = body[0] if body else None
        if not isinstance(hello, Hello) or crc(data[:end], session_crc(hello.boot, hello.turns)) != data[end:]:
            raise CrcError("CRC-32 does not match that of its hello")
    return PacketV1(header, body, repair)


class FormatV1:
    """Implements :class:`gr_ros2.wire.Format`, for packets that are neither sealed nor addressed."""

    version = VERSION
    number_bits = 16
    max_topics = MAX_TOPICS
    min_packet_len = 40
    max_packet_len = 4095

    def largest_message(self, packet_len: int) -> int:  # noqa: ARG002 - the same in packets of any length
        return MAX_MESSAGE

    def single_entry_payload(self, packet_len: int) -> int:
        """Payload bytes of a packet with one entry; this can be one byte more, because the entry may fill the body."""
        return body_room(packet_len) - _ENTRY_COST

    def packed_len(self, payload_lens: Sequence[int]) -> int:
        return HEADER_LEN + REPAIR_HEADER_LEN + CRC_LEN + sum(payload_lens) + _ENTRY_COST * len(payload_lens)

    def layout(self, packet: PacketV1, packet_len: int, size: int | None = None) -> list[Span]:
        header, repair = packet.header, packet.repair
        trailer = TAG_LEN if header.sealed else CRC_LEN
        spans = [Span("head", header.size + (repair.size if repair is not None else 0))]
        free = header.room(packet_len)
        for entry in packet.body:
            written = len(write_body([entry], free))
            shown = (entry,) if isinstance(entry, Part) else ()
            spans.append(Span("entry" if shown else "control", written, *shown))
            free -= written
        if packet.combined:
            spans.append(Span("repair", len(packet.combined)))
        rest = (packet_len if size is None else size) - trailer - sum(span.size for span in spans)
        return [*spans, Span("pad", max(rest, 0)), Span("crc", trailer)]

    def decode(self, data: bytes, packet_len: int) -> PacketV1:
        """The packet in these bytes, as ``decode`` of this module reads it."""
        return decode(data, packet_len)


V1 = FormatV1()
