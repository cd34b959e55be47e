"""The `ofdm` PHY: every packet length passes, airtime and power are what is claimed, and nothing needs a push."""

from __future__ import annotations

import os
import random
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")

import numpy as np
from gnuradio import blocks, gr

from gr_ros2.errors import ConfigError
from gr_ros2.phy.ofdm import OfdmPhy
from tests.gr.probe import Probe, wait_for


class Loop:
    """Transmitter and receiver back to back, the samples between them kept."""

    def __init__(self, phy: OfdmPhy) -> None:
        self.probe = Probe()
        self.top = gr.top_block()
        self.transmitter = phy.transmitter()
        self.samples = blocks.vector_sink_c()
        receiver = phy.receiver()
        self.top.msg_connect((self.probe, "pdus"), (self.transmitter, "pdus"))
        self.top.connect(self.transmitter, self.samples)
        self.top.connect(self.transmitter, receiver)
        self.top.msg_connect((receiver, "pdus"), (self.probe, "pdus"))

    def __enter__(self) -> Loop:
        self.top.start()
        return self

    def __exit__(self, *_error: object) -> None:
        self.top.stop()
        self.top.wait()


def packets(packet_len: int, count: int) -> list[bytes]:
    source = random.Random(packet_len)
    return [source.randbytes(packet_len) for _ in range(count)]


@pytest.mark.parametrize("modulation", ["bpsk", "qpsk"])
@pytest.mark.parametrize("packet_len", [14, 15, 64, 220, 1024, 1500, 4091, 4092, 4095])
def test_every_length_passes_back_to_back_and_the_air_is_as_long_and_as_strong_as_claimed(
    packet_len: int, modulation: str
) -> None:
    phy = OfdmPhy(packet_len, 1e6, payload_modulation=modulation)
    sent = packets(packet_len, 60 if packet_len < 1000 else 15)
    with Loop(phy) as loop:
        for packet in sent:
            loop.probe.post(packet)
        wait_for(lambda: loop.probe.handled >= len(sent), "every packet")
        wait_for(lambda: len(loop.samples.data()) >= len(sent) * phy.airtime_samples(), "every sample")
        assert loop.transmitter.packets_sent() == len(sent)
    assert loop.probe.packets == sent
    samples = np.array(loop.samples.data())
    assert len(samples) == len(sent) * phy.airtime_samples()
    burst = samples.reshape(len(sent), -1)[:, : -phy.gap]
    assert np.all(samples.reshape(len(sent), -1)[:, -phy.gap :] == 0)
    assert np.mean(np.abs(burst) ** 2) == pytest.approx(phy.burst_power(), rel=0.03)


def test_a_single_packet_comes_out_by_itself() -> None:
    with Loop(OfdmPhy(64, 1e6)) as loop:
        for number, packet in enumerate(packets(64, 20), start=1):
            loop.probe.post(packet)
            wait_for(lambda number=number: loop.probe.handled >= number, "the packet just sent")


def test_the_smallest_gap_that_frees_the_last_packet() -> None:
    with Loop(OfdmPhy(64, 1e6, gap=112)) as loop:
        loop.probe.post(packets(64, 1)[0])
        wait_for(lambda: loop.probe.handled, "the packet")


def test_scrambling() -> None:
    with Loop(OfdmPhy(64, 1e6, scramble=True)) as loop:
        loop.probe.post(bytes(64))
        wait_for(lambda: loop.probe.handled, "the packet")
    assert loop.probe.packets == [bytes(64)]


@pytest.mark.parametrize(("modulation", "samples"), [("bpsk", 1200 + 160), ("qpsk", 720 + 160)])
def test_airtime_of_64_bytes(modulation: str, samples: int) -> None:
    phy = OfdmPhy(64, 100e3, payload_modulation=modulation)
    assert phy.airtime_samples() == samples
    assert phy.airtime() == pytest.approx(samples / 100e3)


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"gap": 0}, "gap = 0"),
        ({"payload_modulation": "qam64"}, "payload_modulation = 'qam64'"),
        ({"colour": 1}, "unknown key colour"),
    ],
)
def test_a_wrong_option_is_named(options: dict[str, Any], named: str) -> None:
    with pytest.raises(ConfigError, match=named):
        OfdmPhy(64, 1e6, **options)


@pytest.mark.parametrize("sample_rate", [0.0, -1.0, float("nan")])
def test_a_sample_rate_is_needed(sample_rate: float) -> None:
    with pytest.raises(ConfigError, match="sample_rate"):
        OfdmPhy(64, sample_rate)


def test_the_spinning_thread_runs_when_nothing_else_wants_to() -> None:
    phy = OfdmPhy(64, 1e6)
    with Loop(phy) as loop:
        phy.prefer_latency()
        names = {int(task.name): (task / "comm").read_text() for task in Path("/proc/self/task").iterdir()}
        idle = [task for task in names if os.sched_getscheduler(task) == os.SCHED_IDLE]
        assert [names[task][:10] for task in idle] == ["header_pay"], names
        loop.probe.post(bytes(64))
        wait_for(lambda: loop.probe.handled, "the packet")


def test_numpys_generator_is_left_alone() -> None:
    np.random.seed(7)
    expected = np.random.random()
    np.random.seed(7)
    phy = OfdmPhy(64, 1e6)
    phy.transmitter()
    phy.receiver()
    assert np.random.random() == expected
