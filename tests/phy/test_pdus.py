"""PDUs and bundles: any bytes survive, any garbage is named, and only blocks that understand bundles get them."""

from __future__ import annotations

from typing import Any

import pytest

pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")

import numpy as np
import pmt
from gnuradio import gr
from hypothesis import given
from hypothesis import strategies as st

from gr_ros2.link.events import AirPacket
from gr_ros2.phy.pdus import PduPort, _bundled, packets_of, pdu_heard, pdu_of, pdu_to_send, u8vector
from tests.gr.probe import Probe
from tests.waiting import wait_for

PACKETS = [b"one", b"", b"a longer packet" * 300]


class _Sender(gr.basic_block):  # type: ignore[misc]
    def __init__(self) -> None:
        super().__init__("sender", None, None)
        self.port = PduPort(self)

    def start(self) -> bool:
        self.port.find_readers()
        return True


class _Reader(Probe):
    """A probe that understands bundles."""

    def __init__(self) -> None:
        super().__init__()
        PduPort.readable_by(self)


def _received(*readers: Probe) -> list[list[Any]]:
    """The messages that each reader gets of one call of ``send``, which come to PACKETS."""
    sender, top = _Sender(), gr.top_block()
    for reader in readers:
        top.msg_connect((sender, "pdus"), (reader, "pdus"))
    top.start()
    try:
        sender.port.send([AirPacket(packet) for packet in PACKETS])
        wait_for(lambda: all(_packets(reader.messages) == PACKETS for reader in readers), "all packets")
    finally:
        top.stop()
        top.wait()
    return [reader.messages for reader in readers]


def _packets(messages: list[Any]) -> list[bytes]:
    return [packet.data for message in messages for packet in packets_of(message)[0]]


def test_a_block_that_understands_bundles_gets_all_packets_in_one_message() -> None:
    (messages,) = _received(_Reader())
    assert len(messages) == 1


def test_other_blocks_get_one_pdu_for_each_packet() -> None:
    (messages,) = _received(Probe())
    assert [pmt.is_dict(pmt.car(message)) for message in messages] == [True] * len(PACKETS)


def test_one_block_that_needs_pdus_is_enough_for_all_to_get_them() -> None:
    for messages in _received(_Reader(), Probe()):
        assert len(messages) == len(PACKETS)


def test_a_port_without_a_reader_is_known() -> None:
    sender = _Sender()
    assert not sender.port.find_readers()
    assert not sender.port.bundles


@given(st.binary(max_size=4095))
def test_a_pdu_is_one_packet(data: bytes) -> None:
    assert packets_of(pdu_of(data)) == ([AirPacket(data)], "")


_TIMES = st.none() | st.floats(0, 1e9)
_SNRS = st.none() | st.floats(-100, 100, width=32)


@given(st.lists(st.builds(AirPacket, st.binary(max_size=40), _TIMES, _TIMES, st.none() | st.integers(0, 7), _SNRS)))
def test_a_bundle_carries_what_a_pdu_says(packets: list[AirPacket]) -> None:
    assert packets_of(pmt.cons(pmt.intern("bundle"), u8vector(b"".join(map(_bundled, packets))))) == (packets, "")
    for packet in packets:
        to_send, heard = packet._replace(at=None, snr_db=None), packet._replace(leave_at=None)
        assert packets_of(pdu_to_send(to_send)) == ([to_send], "")
        assert packets_of(pdu_heard(heard)) == ([heard], "")


@pytest.mark.parametrize("value", [pmt.intern("x"), pmt.from_double(float("nan")), pmt.from_complex(1j), pmt.PMT_NIL])
def test_metadata_of_others_says_nothing(value: Any) -> None:
    metadata = pmt.make_dict()
    for key in ("mcs", "snr_db", "received_at", "begins_at", "leave_at"):
        metadata = pmt.dict_add(metadata, pmt.intern(key), value)
    assert packets_of(pdu_of(b"x", metadata)) == ([AirPacket(b"x")], "")


@given(st.binary(max_size=300))
def test_a_bundle_of_any_bytes_is_read(data: bytes) -> None:
    packets, problem = packets_of(pmt.cons(pmt.intern("bundle"), u8vector(data)))
    assert not problem
    assert sum(len(packet.data) for packet in packets) <= len(data)


@pytest.mark.parametrize(
    ("garbage", "reason"),
    [
        (pmt.PMT_NIL, "not_a_pair"),
        (pmt.intern("x"), "not_a_pair"),
        (pmt.from_long(3), "not_a_pair"),
        (pmt.init_u8vector(3, [1, 2, 3]), "not_a_pair"),
        (pmt.cons(pmt.PMT_NIL, pmt.PMT_NIL), "not_u8"),
        (pmt.cons(pmt.make_dict(), pmt.intern("x")), "not_u8"),
        (pmt.cons(pmt.make_dict(), pmt.init_s16vector(3, [1, 2, 3])), "not_u8"),
        (pmt.cons(pmt.make_dict(), pmt.to_pmt(np.zeros(4, np.float32))), "not_u8"),
    ],
)
def test_garbage_is_named(garbage: Any, reason: str) -> None:
    assert packets_of(garbage) == ([], reason)


def test_an_empty_packet_is_a_packet() -> None:
    assert packets_of(pmt.cons(pmt.make_dict(), pmt.init_u8vector(0, []))) == ([AirPacket(b"")], "")
