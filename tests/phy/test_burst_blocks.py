"""Bursts without a stream: the same packets, times and losses as through GNU Radio's streams."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
from gnuradio import gr

from gr_ros2.link.events import AirPacket
from gr_ros2.phy import PHY
from gr_ros2.phy.burst_blocks import BurstTransceiver
from gr_ros2.phy.pdus import packets_of, pdu_to_send
from tests.gr.probe import Probe
from tests.waiting import wait_for

RATE = 1e6
NAMES = ("ofdm", "psk", "gfsk", "lora")
PACKETS = [bytes([number]) * length for number, length in enumerate((64, 1, 30, 64, 17))]


class _Air:
    """Carries bursts to whoever listens, in pieces if told so.

    :ivar sent: samples and time of each burst
    """

    def __init__(self, piece: int = 0) -> None:
        self.sent: list[tuple[Any, float | None]] = []
        self._piece = piece
        self._take: Callable[..., None] | None = None

    def send(self, samples: Any, at: float | None) -> None:
        self.sent.append((samples.copy(), at))
        for first in range(0, len(samples), self._piece or len(samples)):
            assert self._take is not None
            piece = samples[first : first + (self._piece or len(samples))]
            self._take(piece, None if at is None else at + first / RATE)

    def listen(self, take: Callable[..., None] | None) -> None:
        self._take = take


@contextmanager
def _running(phy: Any, air: _Air) -> Iterator[tuple[BurstTransceiver, Probe]]:
    block, probe, top = BurstTransceiver(phy, air), Probe(), gr.top_block()
    top.msg_connect((probe, "pdus"), (block, "pdus"))
    top.msg_connect((block, "pdus"), (probe, "pdus"))
    top.start()
    try:
        yield block, probe
    finally:
        top.stop()
        top.wait()


def _heard(probe: Probe) -> list[AirPacket]:
    return [packet for message in probe.messages for packet in packets_of(message)[0]]


@pytest.mark.parametrize("kernels", ["auto", "numpy"])
@pytest.mark.parametrize("piece", [0, 333])
@pytest.mark.parametrize("name", NAMES)
def test_packets_cross_whole_with_the_times_of_their_bursts(name: str, piece: int, kernels: str) -> None:
    phy, air = PHY.load(name)(64, RATE, kernels=kernels), _Air(piece)
    with _running(phy, air) as (block, _):
        heard: list[AirPacket] = []
        block._port.send = heard.extend  # in the thread that takes a burst
        block.take([AirPacket(packet, at=10.0 + number) for number, packet in enumerate(PACKETS)])
        assert [packet.data for packet in heard] == PACKETS
        for number, packet in enumerate(heard):
            assert packet.at == pytest.approx(10.0 + number, abs=phy.gap / RATE)
        assert (block.packets_sent(), block.refused, block.damaged) == (len(PACKETS), 0, 0)
        assert block.snr_db is not None


@pytest.mark.parametrize("name", NAMES)
def test_the_samples_are_those_of_the_stream(name: str) -> None:
    phy, air = PHY.load(name)(64, RATE), _Air()
    with _running(phy, air) as (block, _):
        block.take([AirPacket(packet) for packet in PACKETS])
    for (samples, at), packet in zip(air.sent, PACKETS, strict=True):
        assert at is None
        assert len(samples) == phy.airtime_samples(len(packet))
        assert np.array_equal(samples[: -phy.gap], phy.running_modem.modulate(packet))
        assert not samples[-phy.gap :].any()


def test_pdus_of_other_blocks_are_sent_and_what_is_no_packet_is_refused() -> None:
    with _running(PHY.load("ofdm")(64, RATE), _Air()) as (block, probe):
        for packet in (PACKETS[0], b"", bytes(65), PACKETS[1]):
            probe.post_message(pdu_to_send(AirPacket(packet)))
        wait_for(lambda: [packet.data for packet in _heard(probe)] == PACKETS[:2], "the packets")
        assert (block.packets_sent(), block.refused) == (2, 2)


def test_a_burst_that_is_cut_costs_itself_and_a_damaged_one_is_counted() -> None:
    phy, air = PHY.load("ofdm")(64, RATE), _Air()
    with _running(phy, air) as (block, probe):
        probe.post(PACKETS[0])
        wait_for(lambda: len(_heard(probe)) == 1, "the packet")
        samples, _ = air.sent[0]
        bad = samples.copy()
        bad[len(bad) // 2 : -phy.gap] *= -1
        block._hear(bad, None)
        block._hear(samples, None)
        wait_for(lambda: len(_heard(probe)) == 2, "the packet after it")
        assert block.damaged == 1


def test_an_engine_that_fails_starts_again(monkeypatch: pytest.MonkeyPatch) -> None:
    phy, air = PHY.load("psk")(64, RATE), _Air()
    with _running(phy, air) as (block, probe):
        engine = block._demodulation._engine

        def fails(_samples: Any) -> Any:
            raise ValueError("broken")

        monkeypatch.setattr(engine, "feed", fails)
        probe.post(PACKETS[0])
        wait_for(lambda: block._demodulation._engine is not engine, "a new engine")
        probe.post(PACKETS[0])
        wait_for(lambda: len(_heard(probe)) == 1, "the packet")
