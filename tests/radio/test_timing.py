"""Packets that ask for a time, through whole radios: when the other end says that they began."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("zmq", reason="needs pyzmq")

from gr_ros2.link.events import AirPacket
from gr_ros2.phy.flowgraph import Flowgraph
from gr_ros2.phy.pdus import packets_of, pdu_to_send
from gr_ros2.radio.radio import Radio, make_radio
from tests.gr.probe import Probe
from tests.waiting import wait_for

RATE = 1e6


def errors_s(sending: Radio, receiving: Radio) -> list[float]:
    """By how much packets are told to have begun later than they asked for, s."""
    probe, top = Probe(), Flowgraph("test", "test")
    top.msg_connect(probe, "pdus", sending, "pdus")
    top.msg_connect(receiving, "pdus", probe, "pdus")
    asked: dict[bytes, float] = {}

    def heard() -> dict[bytes, float | None]:
        packets: list[AirPacket] = [packet for message in probe.messages for packet in packets_of(message)[0]]
        return {packet.data: packet.at for packet in packets if packet.data in asked}

    def one_more() -> bool:
        """Send another one when the last one's time is over; whether enough were heard."""
        if time.monotonic() > max(asked.values(), default=0.0) + 0.05:
            data, at, before = probe.emitted.to_bytes(64, "big"), time.monotonic() + 0.05, sending.gate.arrived
            probe.post_message(pdu_to_send(AirPacket(data, leave_at=at)))
            wait_for(lambda: sending.gate.arrived > before, "a packet to wait for its time")
            if time.monotonic() >= at:
                return False  # a busy machine has brought it too late
            asked[data] = at
        return len(heard()) >= 5

    with top:
        wait_for(one_more, "five packets")
    for radio in {sending, receiving}:
        radio.close()
    return [at - asked[data] for data, at in heard().items() if at is not None]


def test_sim_tells_the_time_asked_for() -> None:
    radio = make_radio("psk", 64, RATE, "sim")
    found = errors_s(radio, radio)
    assert len(found) >= 5
    assert max(map(abs, found)) < radio.front_end.timing_error_s


def test_zmq_tells_the_time_of_arrival_which_is_never_early(tmp_path: Path) -> None:
    addresses = [f"ipc://{tmp_path}/{number}" for number in (1, 2)]
    options: list[dict[str, Any]] = [
        {"bind": own, "connect": [other]} for own, other in (addresses, reversed(addresses))
    ]
    one, two = (make_radio("psk", 64, RATE, "zmq", **each) for each in options)
    found = errors_s(one, two)
    assert len(found) >= 5
    assert min(found) > -two.front_end.timing_error_s
    # How late it is depends on how busy this machine is; most packets are not.
    assert sorted(found)[0] < two.front_end.timing_error_s
