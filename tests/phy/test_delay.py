"""The delay: nothing passes early, nothing is lost, the order stays, and it stops with packets inside."""

from __future__ import annotations

import time

import pytest

pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")

from gr_ros2.phy.delay import PacketDelay
from gr_ros2.phy.flowgraph import Flowgraph
from tests.gr.probe import Probe
from tests.waiting import wait_for


def wire(delay_s: float) -> tuple[Flowgraph, Probe]:
    top, probe, delay = Flowgraph("test", "test"), Probe(), PacketDelay(delay_s)
    top.msg_connect((probe, "pdus"), (delay, "pdus"))
    top.msg_connect((delay, "pdus"), (probe, "pdus"))
    top.start()
    return top, probe


def test_every_packet_leaves_in_order_and_never_before_its_delay() -> None:
    top, probe = wire(0.1)
    posted = []
    for number in range(20):
        posted.append(time.monotonic())
        probe.post(bytes([number]))
    wait_for(lambda: probe.handled == 20, "every packet")
    top.stop()
    assert probe.packets == [bytes([number]) for number in range(20)]
    assert all(left - came >= 0.1 for left, came in zip(probe.times, posted, strict=True))


def test_it_stops_with_packets_inside() -> None:
    top, probe = wire(3600.0)
    probe.post(bytes(1))
    top.stop()
    assert probe.handled == 0
