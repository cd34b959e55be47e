"""Version 1's bytes: properties, sizes, and every small corruption."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gr_ros2.core.errors import EncodeError, WireError
from gr_ros2.wire import is_sealed, v1
from gr_ros2.wire.ages import NO_AGE
from gr_ros2.wire.control import About, Ask, Heard, Hello, LeftOut, Newest, Ping, Report, Waited
from gr_ros2.wire.mac_block import MOST_LEN
from gr_ros2.wire.table import AnnouncedTopic, read_table, write_table
from gr_ros2.wire.v1 import Header, PacketV1, Part, RepairHeader, decode, encode

U8, U16, U32, U64 = (st.integers(0, (1 << bits) - 1) for bits in (8, 16, 32, 64))
BOOT = 0x01020304


def headers(qos: st.SearchStrategy[int], sealed: st.SearchStrategy[bool]) -> st.SearchStrategy[Header]:
    source = st.integers(0, 254)
    address = st.just((v1.BROADCAST, 0)) | st.tuples(st.integers(0, 254), U8)
    block = st.sampled_from((b"", bytes(6), bytes.fromhex("0507078203048000000112fe")))
    made = st.tuples(qos, sealed, source, U16, address, block)
    return made.map(lambda values: Header(*values[:4], *values[4], values[5]))


@st.composite
def parts(draw: st.DrawFn) -> Part:
    offset = draw(st.just(0) | st.integers(1, v1.MAX_MESSAGE - 40))
    last = draw(st.booleans())
    payload = draw(st.binary(min_size=0 if last and not offset else 1, max_size=40))
    back = draw(st.integers(0, v1.MAX_BACK)) if offset else 0
    return Part(draw(st.integers(0, v1.CARRIED_TOPIC)), payload, back, offset, last, draw(st.booleans()))


SNRS = st.none() | st.integers(0, 200).map(lambda steps: steps / 2 - 40)
marks = st.lists(st.tuples(U8, U32), max_size=7).map(tuple)
controls = (
    st.builds(Hello, U32, U32, U8, U32, marks)
    | st.builds(Ask, U8, st.binary(min_size=1, max_size=9))
    | st.builds(Heard, U8, st.binary(min_size=4, max_size=4), st.integers(0, 0xFFFF))
    | st.builds(Ping, U8, U16, st.booleans(), st.booleans(), U16, U16, U64, SNRS)
    | st.builds(About, U16, U32, U32, st.binary(max_size=20))
    | st.builds(Newest, U8, U8, U8, U16, st.none())
    | st.builds(Newest, U8, U8, U8, st.integers(0, 0xFFFF_FFFF), U8)
    | st.builds(Waited, st.binary(min_size=1, max_size=9))
    | st.builds(LeftOut, st.integers(0, 2**16 - 1), st.integers(0, 2**64 - 1), st.booleans())
    | st.builds(Report, U8, U16, U16, U64, st.booleans(), st.integers(0, 127), SNRS)
)
entries = st.lists(parts() | controls, max_size=6).map(tuple)


@st.composite
def repair_headers(draw: st.DrawFn, control: bool) -> RepairHeader:
    repair_id = draw(st.integers(0, 127))
    if control:
        return RepairHeader(repair_id, clear=draw(st.booleans()))
    mask = draw(st.integers(0, (1 << 127) - 1)) | 1
    size = len(v1.write_repair_header(RepairHeader(repair_id, mask)))
    return RepairHeader(repair_id, mask, draw(st.booleans()), size=size)


@st.composite
def packets(draw: st.DrawFn) -> tuple[PacketV1, int, bool]:
    kind = draw(st.sampled_from(("source", "control", "repair")))
    qos = st.integers(0, 2) if kind == "source" else st.just(v1.QOS_REPAIR)
    header = draw(headers(qos, st.just(False)))
    fixed = draw(st.booleans())
    if kind == "repair":
        repair = draw(repair_headers(control=False))
        combined = draw(st.binary(max_size=60))
        least = header.size + repair.size + len(combined) + v1.CRC_LEN
        packet_len = least + draw(st.integers(0, 20))
        combined = combined.ljust(packet_len - least + len(combined), b"\0") if fixed else combined
        return PacketV1(header, (), repair, combined), packet_len, fixed
    repair = draw(repair_headers(control=True)) if kind == "control" else None
    inside = draw(entries)
    used = len(v1.write_body(inside, 1 << 20))
    # Without the length byte of its last entry, it just fits.
    room = used - draw(st.integers(0, 1)) if _last_says_its_length(inside) else used
    room = max(room + draw(st.just(0) | st.integers(0, 20)), 2)
    packet_len = room + header.size + v1.REPAIR_HEADER_LEN + v1.CRC_LEN
    packet_len += MOST_LEN - len(header.block) if header.block else 0
    return PacketV1(header, inside, repair), packet_len, fixed


def _last_says_its_length(inside: tuple[v1.EntryV1, ...]) -> bool:
    return bool(inside) and isinstance(inside[-1], Part) and not 0 < len(inside[-1].payload) <= 15


@given(packets(), U32, U32)
def test_what_is_written_reads_back(case: tuple[PacketV1, int, bool], boot: int, turns: int) -> None:
    packet, packet_len, fixed = case
    data = encode(packet, packet_len, boot, turns, fixed=fixed)
    assert len(data) <= packet_len
    assert not fixed or len(data) == packet_len
    assert decode(data, packet_len, boot, turns) == packet


@given(packets(), st.data())
def test_another_start_of_the_sender_and_every_flipped_bit_are_refused(
    case: tuple[PacketV1, int, bool], draw: st.DataObject
) -> None:
    packet, packet_len, fixed = case
    data = encode(packet, packet_len, BOOT, 7, fixed=fixed)
    flip = draw.draw(st.integers(0, len(data) * 8 - 1))
    damaged = bytearray(data)
    damaged[flip // 8] ^= 1 << flip % 8
    for boot, turns, bytes_ in ((BOOT + 1, 7, data), (BOOT, 8, data), (BOOT, 7, bytes(damaged)), (BOOT, 7, data[:-1])):
        with pytest.raises(WireError):
            decode(bytes_, packet_len, boot, turns)


@given(st.binary(max_size=80), st.integers(0, 80))
def test_any_body_reads_or_is_refused_by_name(body: bytes, room: int) -> None:
    try:
        found = v1.read_body(body, room)
    except WireError as error:
        assert error.kind in {"entry_bounds", "entry_kind", "varint", "pad"}
        return
    again = v1.write_body(found, room)
    assert v1.read_body(again, room) == found or len(again) < room


@given(headers(st.integers(0, 3), st.booleans()), st.binary(min_size=8, max_size=9))
def test_headers_read_back(header: Header, trailer: bytes) -> None:
    assert v1.read_header(v1.write_header(header) + trailer, 64) == header


def test_what_a_key_seals_is_told_by_its_header() -> None:
    for sealed in (False, True):
        assert is_sealed(v1.write_header(Header(0, sealed, 1, 2)) + bytes(9)) is sealed
    assert not is_sealed(bytes([0x08]) + bytes(40)), "version 0"
    assert not is_sealed(b"")


@given(st.binary(max_size=24), st.integers(0, 24))
def test_any_window_and_repair_id_read_or_are_refused_by_name(data: bytes, start: int) -> None:
    try:
        repair = v1.read_repair_header(data, start, len(data))
    except WireError as error:
        assert error.kind in {"entry_bounds", "window"}
        return
    again = v1.write_repair_header(repair)
    assert v1.read_repair_header(again, 0, len(again))[:4] == repair[:4]
    assert repair.size <= len(data) - start


@given(
    st.integers(1, 200),
    st.integers(0, 300),
    st.integers(0, v1.MAX_BACK),
    st.integers(1, v1.MAX_MESSAGE - 300),
    st.booleans(),
)
def test_what_is_said_to_fit_does_fit(room: int, remaining: int, back: int, offset: int, begins: bool) -> None:
    offset, back = (0, 0) if begins else (offset, back)
    if not begins and not remaining:
        return
    taken, used = v1.fit(room, remaining, back, offset)
    if taken < 0:
        assert room < 11
        return
    assert taken == remaining or used == room
    part = Part(1, bytes(taken), back, offset, taken == remaining)
    data = v1.write_body([part], room)
    assert len(data) == used
    assert v1.read_body(data, room) == [part]


@pytest.mark.parametrize(("sealed", "overhead"), [(False, 13), (True, 17)])
def test_the_overhead_of_a_whole_message_is_that_of_version_0(sealed: bool, overhead: int) -> None:
    room = v1.body_room(64, sealed=sealed)
    message = bytes(64 - overhead)
    assert v1.fit(room, len(message), 0, 0) == (len(message), room)
    assert v1.fit(room, len(message) + 1, 0, 0) == (len(message) + 1, room)  # one more: the length goes unsaid


@pytest.mark.parametrize(("size", "packet_len"), [(0, 11), (1, 11), (13, 23), (15, 25), (16, 27)])
def test_short_messages_have_no_length_byte(size: int, packet_len: int) -> None:
    packet = PacketV1(Header(0, False, 1, 1), (Part(0, bytes(size)),))
    data = encode(packet, 64, BOOT, fixed=False)
    assert len(data) == packet_len
    assert decode(data, 64, BOOT) == packet
    assert v1.fit(v1.body_room(64), size, 0, 0) == (size, packet_len - v1.HEADER_LEN - v1.CRC_LEN)


def test_a_length_byte_is_taken_where_none_is_needed() -> None:
    assert v1.read_body(bytes.fromhex("010002aabb"), 40) == v1.read_body(bytes.fromhex("0112aabb"), 40)


def test_an_odometry_message_takes_as_many_packets_as_in_version_0() -> None:
    room, offset, packets = v1.body_room(64), 0, 0
    while offset < 724:
        taken, _ = v1.fit(room, 724 - offset, packets, offset)
        offset += taken
        packets += 1
    assert packets == 15


def test_entries_of_kinds_not_known_are_skipped() -> None:
    part = Part(3, b"x")
    body = bytes((0xF5, 3, 1, 2, 3)) + v1.write_body([part], 40)
    assert v1.read_body(body, 40) == [part]


@pytest.mark.parametrize(
    ("body", "kind"),
    [
        ("01", "entry_bounds"),  # no flags
        ("0100", "entry_bounds"),  # no length
        ("010005aabb", "entry_bounds"),  # five bytes promised
        ("010f", "entry_bounds"),
        ("0110", "entry_kind"),  # fills a body that is shorter than the longest
        ("014000", "entry_kind"),  # a first fragment of no bytes
        ("0180010000aa", "entry_kind"),  # a later fragment at the begin
        ("018001008100aa", "varint"),  # 1 in two bytes
        ("0180010080808080aa", "varint"),
        ("01800100ffffff7faa", "varint"),  # beyond 16 MB
        ("f201", "entry_bounds"),
        ("fa0100", "entry_bounds"),  # a report of one byte
        ("f80100", "entry_bounds"),
        ("f90100", "entry_bounds"),
        ("fb0100", "entry_bounds"),
        ("010001aa0001", "pad"),
    ],
)
def test_bodies_are_refused_by_name(body: str, kind: str) -> None:
    with pytest.raises(WireError) as caught:
        v1.read_body(bytes.fromhex(body), 40)
    assert caught.value.kind == kind


def test_an_addressed_packet_is_two_bytes_longer() -> None:
    message = bytes(49)
    packet = PacketV1(Header(0, False, 1, 5, dst_id=7, hop=2), (Part(0, message),))
    assert decode(encode(packet, 64, BOOT), 64, BOOT) == packet
    with pytest.raises(WireError):
        encode(packet._replace(body=(Part(0, bytes(51)),)), 64, BOOT)


rows = st.builds(
    AnnouncedTopic,
    st.integers(0, 239),
    st.text(max_size=30),
    st.text(max_size=30),
    st.integers(0, 2),
    st.booleans(),
    st.booleans(),
    U8,
    st.text(max_size=20),
    st.booleans(),
    U8,
    st.integers(0, NO_AGE - 1),
)


@given(st.lists(rows, max_size=20, unique_by=lambda row: row.topic_id))
def test_a_table_reads_back(table: list[AnnouncedTopic]) -> None:
    assert read_table(write_table(table)) == tuple(table)


@given(st.binary(max_size=60).map(lambda data: b"\1" + data))
def test_any_table_reads_or_is_refused_by_name(data: bytes) -> None:
    try:
        table = read_table(data)
    except WireError as error:
        assert error.kind in {"entry_bounds", "entry_kind"}
        return
    assert read_table(write_table(table)) == table


@pytest.mark.parametrize("snr_db", [-40.5, 60.5, float("inf"), float("nan")])
def test_an_snr_out_of_range_is_not_reported(snr_db: float) -> None:
    with pytest.raises(EncodeError, match="SNR"):
        v1.write_body([Report(1, 2, 3, 4, False, 5, snr_db)], 40)
