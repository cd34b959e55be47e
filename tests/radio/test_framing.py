"""Packets in a stream of bytes: what goes in comes out, and noise costs the packets that it touches."""

from __future__ import annotations

from collections import Counter

import pytest
from hypothesis import given
from hypothesis import strategies as st

pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")

from gr_ros2.radio.framing import Cobs, Framing, Kiss, Slip

LONGEST = 600
KINDS = (Slip, Kiss, Cobs)
PACKETS = st.binary(min_size=1, max_size=LONGEST) | st.lists(
    st.sampled_from([0, 0xC0, 0xDB, 0xDC, 0xDD, 1, 255]), min_size=1, max_size=LONGEST
).map(bytes)
"""Random bytes, and packets full of those that framing treats differently."""


@pytest.mark.parametrize("kind", KINDS)
@given(packets=st.lists(PACKETS, max_size=5), cuts=st.lists(st.integers(1, 700), max_size=20))
def test_packets_come_out_as_they_went_in_however_the_stream_is_cut(
    kind: type[Framing], packets: list[bytes], cuts: list[int]
) -> None:
    sender, receiver = kind(LONGEST), kind(LONGEST)
    stream = b"".join(sender.frame(packet) for packet in packets)
    pieces = []
    for cut in cuts:
        pieces.append(stream[:cut])
        stream = stream[cut:]
    assert [packet for piece in (*pieces, stream) for packet in receiver.feed(piece)] == packets
    assert not receiver.dropped


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("length", [1, 253, 254, 255, 508, 509])
@pytest.mark.parametrize("behind", [b"", b"\0", b"\0\0", b"\0a"])
def test_runs_as_long_as_a_block_of_cobs(kind: type[Framing], length: int, behind: bytes) -> None:
    packet = (bytes(range(1, 255)) * 3)[:length] + behind
    assert list(kind(LONGEST).feed(kind(LONGEST).frame(packet))) == [packet]


@pytest.mark.parametrize("kind", KINDS)
@given(noise=st.binary(max_size=3000), packet=PACKETS)
def test_after_any_noise_the_second_packet_arrives(kind: type[Framing], noise: bytes, packet: bytes) -> None:
    one = kind(LONGEST)
    list(one.feed(noise))
    assert one.held <= 2 * LONGEST + 8
    arrived = [*one.feed(one.frame(packet)), *one.feed(one.frame(packet))]
    assert arrived[-1] == packet


@pytest.mark.parametrize(
    ("kind", "packet", "frame"),
    [
        (Slip, b"\x01\xc0\x02\xdb\x03", b"\xc0\x01\xdb\xdc\x02\xdb\xdd\x03\xc0"),  # RFC 1055
        (Kiss, b"TEST", b"\xc0\x00TEST\xc0"),  # the KISS paper's first example
        (Cobs, b"\0", b"\0\x01\x01\0"),  # the examples of the COBS paper and of Wikipedia, a zero in front
        (Cobs, b"\x11\x22\0\x33", b"\0\x03\x11\x22\x02\x33\0"),
        (Cobs, b"\x11\0\0\0", b"\0\x02\x11\x01\x01\x01\0"),
        (Cobs, bytes(range(1, 256)), b"\0\xff" + bytes(range(1, 255)) + b"\x02\xff\0"),
    ],
)
def test_frames_are_those_of_the_standards(kind: type[Framing], packet: bytes, frame: bytes) -> None:
    assert kind(LONGEST).frame(packet) == frame


def test_what_is_dropped_is_counted() -> None:
    dropped: Counter[str] = Counter()
    slip, cobs = Slip(10, dropped), Cobs(10, dropped)
    assert list(slip.feed(b"\xc0a\xdbb\xc0" + slip.frame(bytes(11)))) == []
    assert dropped == {"malformed": 1, "too_long": 1}
    assert list(cobs.feed(b"\x05abc\0" + b"x" * 1000 + b"\0" + cobs.frame(b"good"))) == [b"good"]
    assert dropped == {"malformed": 2, "too_long": 2}


def test_other_ports_and_commands_of_a_tnc_are_ignored() -> None:
    second = Kiss(LONGEST, port=1)
    assert second.frame(b"a") == b"\xc0\x10a\xc0"
    assert list(second.feed(b"\xc0\x00a\xc0\x11\x20\xc0\x10b\xc0")) == [b"b"]
    assert not second.dropped
