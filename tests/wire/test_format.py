"""What all versions of the wire format promise to those who know none of them, and how a version is told."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gr_ros2.core.errors import CrcError, EncodeError, LengthError, VersionError
from gr_ros2.wire import FORMATS, Format, decode, format_of, unwrap
from gr_ros2.wire.v0 import V0, EntryV0, PacketV0, with_crc, without_crc

VERSIONS = pytest.mark.parametrize("wire", FORMATS.values(), ids=lambda wire: f"v{wire.version}")
PACKET = V0.encode(PacketV0(1, 255, 7, 1, (EntryV0(0, 9, 0, 1, b"payload"),)), 64)


@VERSIONS
@given(packet_len=st.integers(40, 4095))
def test_capacities_agree_with_each_other(wire: Format, packet_len: int) -> None:
    single = wire.single_entry_payload(packet_len)
    assert wire.packed_len([single]) == packet_len
    assert wire.largest_message(packet_len) >= single


@given(packet_len=st.integers(14, 4095), data=st.data())
def test_capacities_of_version_0_agree_with_each_other(packet_len: int, data: st.DataObject) -> None:
    assert V0.room(packet_len, 0, 0) == V0.single_entry_payload(packet_len)
    lens: list[int] = []
    while (room := V0.room(packet_len, len(lens), sum(lens))) >= 0:
        lens.append(data.draw(st.integers(0, room)))
        assert V0.packed_len(lens) <= packet_len
    assert len(lens) <= V0.max_entries
    count = data.draw(st.integers(1, V0.max_entries))
    equal = V0.equal_entry_payload(packet_len, count)
    assert equal < 0 or V0.packed_len([equal] * count) <= packet_len < V0.packed_len([equal + 1] * count)


@given(size=st.integers(0, 1_100_000))
def test_the_smallest_packet_that_carries_a_message(size: int) -> None:
    packet_len = V0.smallest_packet_len(size)
    if packet_len is None:
        assert V0.largest_message(V0.max_packet_len) < size
    else:
        assert V0.packed_len([0]) <= packet_len <= V0.max_packet_len
        assert V0.largest_message(packet_len) >= size


@given(st.lists(st.integers(0, 30), min_size=1, max_size=15), st.integers(0, 40))
def test_a_layout_is_the_whole_packet(lens: list[int], more: int) -> None:
    packet = PacketV0(1, 255, 0, 1, tuple(EntryV0(0, 0, 0, 1, bytes(n)) for n in lens))
    packet_len = V0.packed_len(lens) + more
    spans = V0.layout(packet, packet_len)
    assert sum(span.size for span in spans) == packet_len
    assert [span.entry for span in spans if span.entry is not None] == list(packet.entries)
    assert [span.size for span in spans if span.kind == "pad"] == [more]


@given(st.lists(st.integers(0, 12), min_size=1, max_size=15))
def test_what_has_no_room_is_refused_by_the_encoder(lens: list[int]) -> None:
    packet_len = V0.packed_len(lens)
    assert V0.room(packet_len, len(lens), sum(lens)) < 0
    entries = tuple(EntryV0(0, 0, 0, 1, bytes(n)) for n in (*lens, 0))
    with pytest.raises(EncodeError):
        V0.encode(PacketV0(1, 255, 0, 1, entries), packet_len)


def test_packets_are_read_by_their_version() -> None:
    assert decode(PACKET, 64) == V0.decode(PACKET, 64)
    assert format_of(0) is V0
    with pytest.raises(VersionError, match="version 9; known are 0, 1"):
        format_of(9)


@pytest.mark.parametrize("version", range(2, 16))
def test_an_unknown_version_is_damage_unless_the_packet_is_intact(version: int) -> None:
    changed = bytes([PACKET[0] | version << 4]) + PACKET[1:]
    with pytest.raises(VersionError):
        decode(with_crc(without_crc(changed)), 64)
    with pytest.raises(CrcError):
        decode(changed, 64)


@pytest.mark.parametrize("data", [b"", b"\0", bytes(63)])
def test_what_is_too_short_is_refused_by_its_length(data: bytes) -> None:
    with pytest.raises(LengthError):
        decode(data, 64)


@given(st.integers(1, 32), st.integers(-(2**40), 2**40), st.data())
def test_what_lies_in_the_window_comes_back(bits: int, least: int, data: st.DataObject) -> None:
    number = data.draw(st.integers(least, least + 2**bits - 1))
    assert unwrap(number % 2**bits, least, bits) == number


def test_both_edges_of_the_window() -> None:
    assert [unwrap(low, 1000 - 63, 8) for low in (937 % 256, 936 % 256)] == [937, 936 + 256]
    assert unwrap(0xFFFF, 0x1_0000 - 64, 16) == 0xFFFF
    assert unwrap(0, 0, 16) == 0
