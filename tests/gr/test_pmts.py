"""PDUs with metadata: any bytes survive."""

from __future__ import annotations

import pmt
from hypothesis import given
from hypothesis import strategies as st

from gr_ros2.gr.radio_ports import PduMaker
from gr_ros2.link.events import AirPacket
from gr_ros2.phy.pdus import packets_of
from gr_ros2.wire.v0 import PacketV0

PACKET = PacketV0(1, 255, 0, 1, ())


@given(st.binary(min_size=14, max_size=4095))
def test_bytes_survive(data: bytes) -> None:
    assert packets_of(PduMaker().pdu(PACKET, AirPacket(data), 0.0)) == ([AirPacket(data)], "")


@given(st.binary(min_size=14, max_size=300))
def test_a_pdu_is_what_gnu_radio_itself_would_make(data: bytes) -> None:
    vector = pmt.cdr(PduMaker().pdu(PACKET, AirPacket(data), 0.0))
    assert pmt.equal(vector, pmt.init_u8vector(len(data), list(data)))


def test_metadata_says_what_the_packet_says() -> None:
    maker = PduMaker()
    for seq in (7, 8, 7):
        packet = PacketV0(3, 255, seq, 1, (), qos=1)
        metadata = pmt.to_python(pmt.car(maker.pdu(packet, AirPacket(bytes(64)), 12.5)))
        assert metadata == {"src_id": 3, "dst_id": 255, "seq": seq, "qos": 1, "t_src_wall": 12.5}


def test_remembered_metadata_is_bounded() -> None:
    maker = PduMaker()
    for number in range(10_000):
        maker.pdu(PacketV0(number >> 8, 255, number & 255, 1, ()), AirPacket(bytes(14)), 0.0)
    assert len(maker._metadata) <= 4096
