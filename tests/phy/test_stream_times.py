"""Packets leave and arrive at known times: through real flowgraphs, to about a sample."""

from __future__ import annotations

from typing import Any

import numpy as np
import pmt
import pytest
from gnuradio import blocks, gr

from gr_ros2.link.events import AirPacket
from gr_ros2.phy import PHY
from gr_ros2.phy.airtime import AirtimeGate
from gr_ros2.phy.flowgraph import Flowgraph
from gr_ros2.phy.pdus import packets_of, pdu_to_send
from gr_ros2.phy.stream_times import RX_TIME, StreamTimes, seconds_of, whole_and_rest
from tests.gr.probe import Probe
from tests.waiting import wait_for

RATE = 1e6
SETTINGS: list[tuple[str, dict[str, Any], float]] = [
    ("ofdm", {}, 2),
    ("ofdm", {"rate": "adaptive"}, 2),
    ("psk", {"fec": "cc"}, 2),
    ("gfsk", {}, 2),
    ("lora", {}, 8),
]
"""A PHY, its settings, and samples by which its receiver may err at 25 dB."""


def heard(messages: list[Any]) -> list[AirPacket]:
    return [packet for message in messages for packet in packets_of(message)[0]]


@pytest.mark.parametrize("kernels", ["auto", "numpy"])
@pytest.mark.parametrize(("name", "options", "near"), SETTINGS)
def test_a_burst_at_a_known_sample_is_received_with_its_time(
    name: str, options: dict[str, Any], near: float, kernels: str
) -> None:
    phy, draw = PHY.load(name)(64, RATE, kernels=kernels, **options), np.random.default_rng(7)
    packets = [draw.bytes(length) for length in (64, 1, 30, 64)]
    samples, begins = np.zeros(0, np.complex64), []
    for packet in packets:
        silence = np.zeros(int(draw.integers(500, 9000)), np.complex64)
        begins.append(len(samples) + len(silence))
        samples = np.concatenate((samples, silence, phy.running_modem.modulate(packet)))
    samples = np.pad(samples, (0, 5000))
    noise = draw.standard_normal((2, len(samples))) * np.sqrt(phy.burst_power() / 2 / 10**2.5)
    tag = gr.tag_t()
    tag.offset, tag.key, tag.value = 0, RX_TIME, whole_and_rest(1234.25)
    probe, top = Probe(), Flowgraph("test", "test")
    source = blocks.vector_source_c((samples + noise[0] + 1j * noise[1]).tolist(), False, 1, [tag])
    receiver = phy.receiver()
    receiver.follow_clock(lambda: 0.5)
    top.connect(source, receiver)
    top.msg_connect(receiver, "pdus", probe, "pdus")
    with top:
        wait_for(lambda: len(heard(probe.messages)) == len(packets), "every packet")
    for packet, data, begin in zip(heard(probe.messages), packets, begins, strict=True):
        assert packet.data == data
        assert packet.at == pytest.approx(1234.75 + begin / RATE, abs=near / RATE)


def test_a_packet_that_asks_for_a_time_is_received_with_it() -> None:
    """Through the gate, the transmitter and the receiver; the samples themselves take no time."""
    phy, probe, top = PHY.load("ofdm")(64, RATE), Probe(), Flowgraph("test", "test")
    now = 1000.0
    gate = AirtimeGate(phy.airtime(), clock=lambda: now)
    transmitter, receiver = phy.transmitter(), phy.receiver()
    top.connect(transmitter, receiver)
    top.msg_connect(probe, "pdus", gate, "pdus")
    top.msg_connect(gate, "pdus", transmitter, "pdus")
    top.msg_connect(receiver, "pdus", probe, "pdus")
    with top:
        asked = [now + 0.1 + number * 0.025 for number in range(4)]
        for number, at in enumerate(asked):
            probe.post_message(pdu_to_send(AirPacket(bytes([number]) * 60, leave_at=at)))
        wait_for(lambda: gate.arrived == len(asked), "the gate to know of every packet")
        now = 1001.0  # not before: a packet that comes late leaves late
        wait_for(lambda: len(heard(probe.messages)) == len(asked), "every packet")
    got = heard(probe.messages)
    assert [packet.at for packet in got] == pytest.approx(asked, abs=2 / RATE)
    assert gate.passed == len(asked)


def test_without_a_tag_the_arrival_of_the_last_sample_counts() -> None:
    times = StreamTimes(1000.0, clock=iter((5.0, 6.0)).__next__)
    times.arrived(500, [])
    times.arrived(800, [])
    assert times.at(100, 400, 0) == pytest.approx(5.0 - 0.4)
    assert times.at(600, 790, 0) == pytest.approx(6.0 - 0.2)


def test_the_time_of_a_device_is_turned_into_that_of_the_machine() -> None:
    times = StreamTimes(1000.0)
    times.offset = lambda: 100.0
    tag = gr.tag_t()
    tag.offset, tag.key, tag.value = 50, RX_TIME, whole_and_rest(3.25)
    times.arrived(100, [tag])
    assert times.at(60, 90, 0) == pytest.approx(103.26)


def test_a_device_without_a_clock_tells_no_time() -> None:
    times = StreamTimes(1000.0, clock=lambda: 7.0)
    tag = gr.tag_t()
    tag.offset, tag.key, tag.value = 0, RX_TIME, whole_and_rest(0.0)
    times.arrived(100, [tag])
    assert times.at(0, 90, 0) == pytest.approx(6.9)


@pytest.mark.parametrize(
    "value", [pmt.PMT_NIL, pmt.intern("x"), pmt.from_long(3), pmt.make_tuple(pmt.from_long(-1), pmt.PMT_T)]
)
def test_a_tag_of_another_form_says_nothing(value: Any) -> None:
    assert seconds_of(value) is None
