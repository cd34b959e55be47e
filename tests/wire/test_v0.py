"""The version-0 codec against byte vectors, properties, and every small corruption."""

from __future__ import annotations

import itertools
import json
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gr_ros2.core.errors import GrRos2Error
from gr_ros2.wire import (
    CrcError,
    EncodeError,
    EntryBoundsError,
    IndexRangeError,
    LengthError,
    NoEntriesError,
    PadError,
    TotalError,
    VersionError,
    WireError,
)
from gr_ros2.wire.v0 import V0, EntryV0, PacketV0, overhead, with_crc

VECTORS = json.loads((Path(__file__).parent.parent / "vectors" / "v0.json").read_text())
ERRORS = {
    "crc": CrcError,
    "length": LengthError,
    "no entries": NoEntriesError,
    "entry overruns packet": EntryBoundsError,
    "pad not zero": PadError,
    "index": IndexRangeError,
    "total": TotalError,
    "version": VersionError,
}


def packet_of(values: dict[str, Any]) -> PacketV0:
    entries = tuple(EntryV0(**{**entry, "payload": bytes.fromhex(entry["payload"])}) for entry in values["entries"])
    return PacketV0(**{**values, "entries": entries})


@st.composite
def packets(draw: st.DrawFn) -> tuple[PacketV0, int]:
    """A packet and a packet_len that holds it."""
    byte = st.integers(0, 255)
    entries = []
    for _ in range(draw(st.integers(1, 15))):
        total = draw(st.integers(1, 255))
        index = draw(st.integers(0, total - 1))
        entries.append(EntryV0(draw(st.integers(0, 15)), draw(byte), index, total, draw(st.binary(max_size=60))))
    packet = PacketV0(
        draw(st.integers(0, 254)),
        draw(byte),
        draw(byte),
        draw(st.integers(0, 15)),
        tuple(entries),
        qos=draw(st.integers(0, 2)),
        compressed=draw(st.booleans()),
        encrypted=draw(st.booleans()),
    )
    needed = V0.packed_len([len(entry.payload) for entry in entries])
    return packet, needed + draw(st.integers(0, 80))


@pytest.mark.parametrize("case", VECTORS["valid"], ids=lambda case: str(case["name"]))
def test_valid_vector_reads_and_writes(case: dict[str, Any]) -> None:
    data, packet = bytes.fromhex(case["hex"]), packet_of(case["packet"])
    assert V0.decode(data, case["packet_len"]) == packet
    assert V0.encode(packet, case["packet_len"]) == data


@pytest.mark.parametrize("case", VECTORS["invalid"], ids=lambda case: str(case["name"]))
def test_invalid_vector_is_refused_by_name(case: dict[str, Any]) -> None:
    with pytest.raises(ERRORS[case["error"]]):
        V0.decode(bytes.fromhex(case["hex"]), case["packet_len"])


def test_vectors_are_those_shared_with_other_implementations() -> None:
    shared = Path(__file__).parents[3] / "shared" / "vectors" / "v0.json"
    if not shared.exists():
        pytest.skip("no shared vectors beside this checkout")
    assert json.loads(shared.read_text()) == VECTORS


@given(packets())
def test_round_trip(case: tuple[PacketV0, int]) -> None:
    packet, packet_len = case
    data = V0.encode(packet, packet_len)
    assert len(data) == packet_len
    assert V0.decode(data, packet_len) == packet


def test_every_one_and_two_bit_flip_of_a_packet_is_refused() -> None:
    good = bytes.fromhex(VECTORS["valid"][0]["hex"])
    bits = range(len(good) * 8)
    value = int.from_bytes(good, "big")
    for flips in itertools.chain(((bit,) for bit in bits), itertools.combinations(bits, 2)):
        damaged = value
        for bit in flips:
            damaged ^= 1 << bit
        with pytest.raises(WireError):
            V0.decode(damaged.to_bytes(len(good), "big"), len(good))


def test_two_bit_flips_are_caught_up_to_the_largest_packet() -> None:
    """The CRC is linear: all two-bit errors are caught if and only if all one-bit remainders differ and none is 0."""
    ends = (with_crc((1 << bit).to_bytes(4095, "big"))[-2:] for bit in range(0, 4095 * 8, 8))
    remainders = {int.from_bytes(end, "big") for end in ends}
    assert len(remainders) == 4095
    every = set()
    remainder = 0x1021
    for _ in range(4095 * 8):
        every.add(remainder)
        remainder = remainder << 1 ^ (0x11021 if remainder & 0x8000 else 0)
    assert remainders <= every
    assert len(every) == 4095 * 8
    assert 0 not in every


@given(st.binary(max_size=300), st.integers(0, 300))
def test_arbitrary_bytes_raise_nothing_but_wire_errors(data: bytes, packet_len: int) -> None:
    try:
        V0.decode(data, packet_len)
    except WireError as error:
        assert isinstance(error, GrRos2Error)
        assert error.kind != "wire"


@given(st.binary(min_size=3, max_size=120))
def test_arbitrary_bodies_with_a_right_crc_decode_or_are_refused_by_name(body: bytes) -> None:
    data = with_crc(bytes([body[0] & 15]) + body[1:])
    try:
        packet = V0.decode(data, len(data))
    except WireError as error:
        assert error.kind in {"length", "no_entries", "entry_bounds", "pad", "total", "index"}
        return
    if packet.src_id < 255:
        again = V0.decode(V0.encode(packet, len(data)), len(data))
        assert again == packet


def test_reserved_qos_reads_as_default_and_spare_nibble_is_ignored() -> None:
    data = bytearray(V0.encode(PacketV0(1, 255, 0, 1, (EntryV0(3, 0, 0, 1, b"x"),), qos=2), 20)[:-2])
    data[0] |= 3 << 2
    data[5] |= 0xF
    packet = V0.decode(with_crc(bytes(data)), 20)
    assert packet.qos == 0
    assert packet.entries[0].topic_id == 3


def test_source_255_is_read_but_not_written() -> None:
    data = bytearray(V0.encode(PacketV0(1, 255, 0, 1, (EntryV0(3, 0, 0, 1, b"x"),)), 20)[:-2])
    data[1] = 255
    packet = V0.decode(with_crc(bytes(data)), 20)
    assert packet.src_id == 255
    with pytest.raises(EncodeError):
        V0.encode(packet, 20)


@pytest.mark.parametrize(
    ("changes", "packet_len"),
    [
        ({"entries": ()}, 64),
        ({"entries": (EntryV0(0, 0, 0, 1, b""),) * 16}, 200),
        ({"entries": (EntryV0(0, 0, 0, 1, bytes(52)),)}, 64),
        ({"entries": (EntryV0(16, 0, 0, 1, b""),)}, 64),
        ({"entries": (EntryV0(0, 256, 0, 1, b""),)}, 64),
        ({"entries": (EntryV0(0, 0, 1, 1, b""),)}, 64),
        ({"entries": (EntryV0(0, 0, 0, 256, b""),)}, 64),
        ({"entries": (EntryV0(0, 0, 0, 0, b""),)}, 64),
        ({"version": 1}, 64),
        ({"qos": 4}, 64),
        ({"hop": 16}, 64),
        ({"src_id": 256}, 64),
        ({"dst_id": 256}, 64),
        ({"seq": -1}, 64),
    ],
)
def test_what_the_wire_cannot_say_is_refused(changes: dict[str, Any], packet_len: int) -> None:
    values: dict[str, Any] = {
        "src_id": 1,
        "dst_id": 255,
        "seq": 0,
        "hop": 1,
        "entries": (EntryV0(0, 0, 0, 1, b""),),
        **changes,
    }
    with pytest.raises(EncodeError):
        V0.encode(PacketV0(**values), packet_len)


def test_sizes_are_those_of_the_paper() -> None:
    assert [overhead(count) for count in (1, 2, 3, 15)] == [8, 8, 9, 15]
    assert V0.single_entry_payload(64) == 51
    assert V0.equal_entry_payload(220, 2) == 101
    assert V0.packed_len([101, 101]) == 220
    assert -(-724 // V0.single_entry_payload(64)) == 15
