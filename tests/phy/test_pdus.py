"""PDUs and calls: any bytes survive, any garbage is named, and blocks are called only where all readers can be."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise
from typing import Any

import numpy as np
import pmt
import pytest
from gnuradio import gr
from hypothesis import given
from hypothesis import strategies as st

from gr_ros2.link.events import AirPacket
from gr_ros2.phy.airtime import AirtimeGate
from gr_ros2.phy.pdus import PduPort, packets_of, pdu_heard, pdu_of, pdu_to_send, take_messages
from tests.gr.probe import Probe
from tests.waiting import wait_for

_OTHER = pmt.dict_add(pmt.make_dict(), pmt.intern("src_id"), pmt.from_long(7))
PACKETS = [b"one", b"", b"a longer packet" * 300]


class _Sender(gr.basic_block):  # type: ignore[misc]
    def __init__(self) -> None:
        super().__init__("sender", None, None)
        self.port = PduPort(self)

    def start(self) -> bool:
        self.port.find_readers()
        return True


class _Reader(gr.basic_block):  # type: ignore[misc]
    """A block that can be called."""

    def __init__(self) -> None:
        super().__init__("reader", None, None)
        take_messages(self, "pdus", "_collect", called="take")
        self.messages: list[Any] = []
        self.calls: list[list[bytes]] = []
        self.threads: set[int] = set()

    def take(self, packets: Sequence[AirPacket]) -> None:
        self.calls.append([packet.data for packet in packets])
        self.threads.add(threading.get_ident())

    def _collect(self, message: Any) -> None:
        self.messages.append(message)


@contextmanager
def _running(*chain: Any, beside: Sequence[Any] = ()) -> Iterator[_Sender]:
    """A sender that the first block of a chain reads, and the blocks beside it."""
    sender, top = _Sender(), gr.top_block()
    for block, reader in [*pairwise((sender, *chain)), *((sender, reader) for reader in beside)]:
        top.msg_connect((block, "pdus"), (reader, "pdus"))
    top.start()
    try:
        yield sender
    finally:
        top.stop()
        top.wait()


def _packets(messages: list[Any]) -> list[bytes]:
    return [packet.data for message in messages for packet in packets_of(message)[0]]


def test_a_block_of_this_package_is_called_in_the_thread_that_sends() -> None:
    reader = _Reader()
    with _running(reader) as sender:
        sender.port.send([AirPacket(packet) for packet in PACKETS])
        assert (reader.calls, reader.threads) == ([PACKETS], {threading.get_ident()})


def test_other_blocks_get_one_pdu_for_each_packet() -> None:
    probe = Probe()
    with _running(probe) as sender:
        sender.port.send([AirPacket(packet) for packet in PACKETS])
        wait_for(lambda: _packets(probe.messages) == PACKETS, "all packets")
    assert [pmt.is_dict(pmt.car(message)) for message in probe.messages] == [True] * len(PACKETS)


def test_one_block_that_needs_pdus_is_enough_for_all_to_get_them() -> None:
    reader, probe = _Reader(), Probe()
    with _running(reader, beside=[probe]) as sender:
        sender.port.send([AirPacket(packet) for packet in PACKETS])
        wait_for(lambda: all(_packets(one.messages) == PACKETS for one in (reader, probe)), "all packets")
    assert not reader.calls


@pytest.mark.parametrize("airtime", [0.0, 1e-3])
def test_a_gate_is_called_where_all_behind_it_can_be(airtime: float) -> None:
    for last, called in ((_Reader(), True), (Probe(), False)):
        with _running(AirtimeGate(airtime), last) as sender:
            assert sender.port.direct == called


def test_what_other_blocks_say_of_a_packet_passes_a_gate_that_blocks_of_this_package_read() -> None:
    reader, probe, gate = _Reader(), Probe(), AirtimeGate(1e-3)
    with _running(gate, reader) as sender:
        sender.port._publish(pmt.intern("pdus"), pdu_of(b"x"))
        sender.port._publish(pmt.intern("pdus"), pmt.from_long(3))
        wait_for(lambda: reader.calls == [[b"x"]], "the packet")
        wait_for(lambda: gate.account()["refused"] == {"not_a_pair": 1}, "what is no packet")
    with _running(AirtimeGate(1e-3), probe) as sender:
        sender.port._publish(pmt.intern("pdus"), pdu_to_send(AirPacket(b"x"), _OTHER))
        wait_for(lambda: probe.messages, "the packet")
        assert pmt.to_python(pmt.car(probe.messages[0]))["src_id"] == 7


def test_a_port_without_a_reader_is_known() -> None:
    sender = _Sender()
    assert not sender.port.find_readers()
    assert not sender.port.direct


@given(st.binary(max_size=4095))
def test_a_pdu_is_one_packet(data: bytes) -> None:
    assert packets_of(pdu_of(data)) == ([AirPacket(data)], "")


_TIMES = st.none() | st.floats(0, 1e9)
_SNRS = st.none() | st.floats(-100, 100, width=32)


@given(st.lists(st.builds(AirPacket, st.binary(max_size=40), _TIMES, _TIMES, st.none() | st.integers(0, 7), _SNRS)))
def test_a_pdu_carries_what_a_packet_says(packets: list[AirPacket]) -> None:
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
