"""The SNR a receiver tells, against that of the channel before it."""

from __future__ import annotations

from math import log10
from typing import Any

import numpy as np
import pytest

from gr_ros2.phy import PHY, Phy
from gr_ros2.phy.burst import BurstReceiver
from gr_ros2.phy.theory import half_point
from gr_ros2.settings.config import ChannelConfig
from tests.gr.probe import Probe
from tests.phy.loopback import Loopback
from tests.phy.test_burst import NAMES, bursts, delayed, noise
from tests.waiting import wait_for

SETTINGS: list[tuple[str, dict[str, Any]]] = [
    ("ofdm", {}),
    ("ofdm", {"payload_modulation": "16qam", "fec": "cc"}),
    ("ofdm", {"fft_len": 256, "carriers": 90, "scramble": True}),
    ("gfsk", {}),
    ("gfsk", {"sps": 3, "bt": 0.3, "fec": "cc"}),
    ("psk", {}),
    ("psk", {"modulation": "8psk", "rolloff": 0.2, "sps": 2}),
    ("psk", {"modulation": "bpsk", "fec": "polar", "rolloff": 1.0}),
    ("lora", {}),
    ("lora", {"spreading_factor": 9, "coding_rate": 2}),
]
COUNT = 16
TOLERANCE_DB = 1.5


def made(name: str, options: dict[str, Any]) -> Any:
    return PHY.load(name)(64, 1e6, **options)


def hear(engine: BurstReceiver, phy: Any, samples: Any) -> int:
    """Feed samples, through the receiver's filter; returns how many packets they held."""
    if phy.receiver_taps is not None:
        samples = np.convolve(samples, phy.receiver_taps)
    return len(engine.feed(samples.astype(np.complex64)))


def through(phy: Any, snr_db: float, taps: tuple[float, ...] = (1.0,), seed: int = 0) -> tuple[Any, float]:
    """Bursts behind a channel, between two samples and off the carrier, and their true SNR in dB."""
    _, clean = bursts(phy, COUNT, seed)
    sent = np.convolve(clean, taps)
    power = float((np.abs(sent) ** 2).sum()) / (COUNT * phy.modem.burst_samples)
    sent = delayed(sent, 0.3) * np.exp(0.004j * np.arange(len(sent)))
    level = snr_db - 10 * log10(phy.burst_power())
    noise_power = phy.burst_power() / 10 ** (snr_db / 10)
    return sent + noise(len(sent), level, seed), 10 * log10(power / noise_power)


@pytest.mark.parametrize("above_db", [4.0, 14.0, 24.0])
@pytest.mark.parametrize(("name", "options"), SETTINGS, ids=str)
def test_it_is_that_of_the_channel_from_where_packets_arrive(
    name: str, options: dict[str, Any], above_db: float
) -> None:
    phy = made(name, options)
    samples, snr_db = through(phy, half_point(phy.computed_pdr) + above_db)
    engine = BurstReceiver(phy.modem)
    assert hear(engine, phy, samples) > 0
    assert engine.snr_db == pytest.approx(snr_db, abs=TOLERANCE_DB)


@pytest.mark.parametrize("name", NAMES)
def test_an_echo_is_no_noise(name: str) -> None:
    phy = made(name, {})
    samples, snr_db = through(phy, half_point(phy.computed_pdr) + 15, taps=(1, 0, 0, 0.4))
    engine = BurstReceiver(phy.modem)
    assert hear(engine, phy, samples) > 0
    assert engine.snr_db == pytest.approx(snr_db, abs=TOLERANCE_DB)


@pytest.mark.parametrize("name", NAMES)
def test_only_packets_that_arrive_change_it(name: str) -> None:
    phy = made(name, {})
    engine = BurstReceiver(phy.modem)
    hear(engine, phy, noise(50_000, 0.0))
    assert engine.snr_db is None
    samples, _ = through(phy, 15.0)
    hear(engine, phy, samples)
    known = engine.snr_db
    assert known is not None
    _, damaged = bursts(phy, 4, seed=1)
    airtime = phy.airtime_samples()
    for start in range(400, 400 + 4 * airtime, airtime):
        damaged[start + airtime // 2 : start + airtime * 5 // 6] = 0
    before = engine.damaged
    assert hear(engine, phy, damaged + noise(len(damaged), 20.0)) == 0
    hear(engine, phy, noise(50_000, 0.0))
    assert engine.damaged > before
    assert engine.snr_db == known


@pytest.mark.parametrize("name", NAMES)
def test_it_is_that_of_the_newest_packets(name: str) -> None:
    phy = made(name, {})
    engine = BurstReceiver(phy.modem)
    for snr_db in (25.0, half_point(phy.computed_pdr) + 6):
        samples, true_db = through(phy, snr_db)
        assert hear(engine, phy, samples) == COUNT
    assert engine.snr_db == pytest.approx(true_db, abs=TOLERANCE_DB)


@pytest.mark.parametrize("name", NAMES)
def test_without_noise_it_is_high_and_finite(name: str) -> None:
    phy = made(name, {})
    engine = BurstReceiver(phy.modem)
    packets, samples = bursts(phy, 3)
    assert hear(engine, phy, samples) == len(packets)
    assert engine.snr_db is not None
    assert 40 < engine.snr_db <= 60


@pytest.mark.parametrize(
    ("name", "options", "told"),
    [*((name, {}, True) for name in NAMES), ("ofdm", {"detection_threshold": "stock"}, False), ("direct", {}, False)],
    ids=str,
)
def test_a_flowgraph_tells_it_where_the_phy_knows_it(name: str, options: dict[str, Any], told: bool) -> None:
    phy: Phy = made(name, options)
    channel = ChannelConfig(snr_db=14.0, frequency_offset=0.001, seed=1) if phy.has_samples else ChannelConfig()
    source, sink = Probe(), Probe()
    with Loopback(phy, source, sink, channel=channel) as link:
        assert link.radio.snr_db is None
        for number in range(COUNT):
            source.post(bytes([number] * 64))
        wait_for(lambda: sink.handled == COUNT, "every packet")
        assert (link.radio.snr_db is not None) == told
    if told:  # also when it has stopped
        assert link.radio.snr_db == pytest.approx(14.0, abs=TOLERANCE_DB)
