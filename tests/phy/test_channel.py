"""The channel: as much noise and fading as asked for, losses that repeat with the seed, changes while running."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from gnuradio import blocks, gr

from gr_ros2.core.errors import ConfigError
from gr_ros2.phy.channel import BurstChannel, Channel, PacketLoss, noise_voltage
from gr_ros2.phy.ofdm import OfdmPhy
from gr_ros2.settings.config import ChannelConfig
from tests.gr.probe import Probe
from tests.waiting import wait_for

SAMPLES, RATE = 200_000, 1e6


def through(config: ChannelConfig, value: complex = 0j) -> np.ndarray:
    """What a constant becomes on its way through a channel."""
    return samples_through(config, np.full(SAMPLES, value))


def samples_through(config: ChannelConfig, samples: np.ndarray) -> np.ndarray:
    top = gr.top_block()
    channel = Channel(config, OfdmPhy(64, RATE))
    sink = blocks.vector_sink_c()
    top.connect(blocks.vector_source_c(samples), channel, sink)
    top.run()
    return np.array(sink.data())


@pytest.mark.parametrize("snr_db", [0.0, 10.0, 20.0])
def test_noise_has_the_power_the_snr_says(snr_db: float) -> None:
    noise = np.mean(np.abs(through(ChannelConfig(snr_db=snr_db))) ** 2)
    power = OfdmPhy(64, 1e6).burst_power()
    assert 10 * np.log10(power / noise) == pytest.approx(snr_db, abs=0.2)


def test_no_noise_where_none_is_asked_for() -> None:
    assert np.allclose(through(ChannelConfig(), 1 + 1j), 1 + 1j, atol=1e-5)


def test_the_gain_of_the_taps_counts_as_signal() -> None:
    assert noise_voltage(0.0, 4.0) == pytest.approx(2.0)
    assert noise_voltage(0.0, 4.0, (1.0, 1.0)) == pytest.approx(8**0.5)
    assert noise_voltage(None, 4.0) == 0.0


def test_equal_seeds_give_equal_noise() -> None:
    first, again = (through(ChannelConfig(snr_db=10, seed=3)) for _ in range(2))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, through(ChannelConfig(snr_db=10, seed=4)))


@pytest.mark.parametrize("snr_db", [0.0, 20.0])
def test_bursts_get_as_much_noise_as_a_stream(snr_db: float) -> None:
    phy = OfdmPhy(64, RATE)
    noise = BurstChannel(ChannelConfig(snr_db=snr_db), phy)(np.zeros(SAMPLES, np.complex64))
    assert np.mean(np.abs(noise) ** 2) == pytest.approx(phy.burst_power() / 10 ** (snr_db / 10), rel=0.02)
    assert abs(np.mean(noise**2)) < 0.02 * np.mean(np.abs(noise) ** 2)
    assert np.mean(np.abs(through(ChannelConfig(snr_db=snr_db))) ** 2) == pytest.approx(
        np.mean(np.abs(noise) ** 2), rel=0.02
    )


def test_bursts_are_offset_in_frequency_as_a_stream_is_wherever_they_are_cut() -> None:
    channel = BurstChannel(ChannelConfig(frequency_offset=0.01), OfdmPhy(64, RATE))
    ones = np.ones(1000, np.complex64)
    got = np.concatenate([channel(ones[:300]), channel(ones[300:])])
    turns = np.unwrap(np.angle(through(ChannelConfig(frequency_offset=0.01), 1.0)[1000:2000]))
    assert np.allclose(np.diff(np.unwrap(np.angle(got))), np.diff(turns), atol=1e-3)
    channel.set_frequency_offset(0.0)
    assert channel(ones) is ones


@pytest.mark.parametrize("kind", [Channel, BurstChannel])
def test_a_change_out_of_range_is_refused(kind: Any) -> None:
    channel = kind(ChannelConfig(), OfdmPhy(64, 1e6))
    channel.set_snr_db(20.0)
    channel.set_frequency_offset(0.01)
    assert (channel.config.snr_db, channel.config.frequency_offset) == (20.0, 0.01)
    with pytest.raises(ConfigError, match="snr_db"):
        channel.set_snr_db(1000.0)
    with pytest.raises(ConfigError, match="frequency_offset"):
        channel.set_frequency_offset(3.0)


def test_fading_is_rayleigh_with_the_doppler_asked_for() -> None:
    doppler_hz = 2000.0
    gain = through(ChannelConfig(doppler_hz=doppler_hz, seed=2), 1.0)
    power = np.abs(gain) ** 2
    assert np.mean(power) == pytest.approx(1.0, abs=0.03)
    for level in (0.1, 0.5, 2.0):
        assert np.mean(power < level) == pytest.approx(1 - np.exp(-level), abs=0.04)
    for lag in (50, 100, 191, 300):  # samples; Clarke's autocorrelation J0(2 pi f_d t), first zero at 191
        similar = np.mean(gain[:-lag] * np.conj(gain[lag:])).real
        assert similar == pytest.approx(bessel_j0(2 * np.pi * doppler_hz * lag / RATE), abs=0.1)


def bessel_j0(x: float) -> float:
    """By its integral, so that nothing but numpy is needed."""
    return float(np.mean(np.cos(x * np.sin((np.arange(1000) + 0.5) / 1000 * np.pi))))


def test_every_tap_fades_by_itself_where_it_stands() -> None:
    spacing, delay = 100, 3
    impulses = np.zeros(SAMPLES)
    impulses[::spacing] = 1.0
    config = ChannelConfig(doppler_hz=5000, taps=(1, 0, 0, 0.5j), seed=1)
    out = samples_through(config, impulses)
    out = out[: len(out) // spacing * spacing].reshape(-1, spacing)
    place = int(np.argmax(np.mean(np.abs(out) ** 2, axis=0)))
    first, second = out[:, place], out[:, (place + delay) % spacing]
    assert np.mean(np.abs(second) ** 2) == pytest.approx(0.25 * np.mean(np.abs(first) ** 2), rel=0.15)
    assert np.abs(np.corrcoef(np.abs(first), np.abs(second))[0, 1]) < 0.2


def test_equal_seeds_give_equal_fades() -> None:
    first, again = (through(ChannelConfig(doppler_hz=100, seed=3), 1.0) for _ in range(2))
    assert np.array_equal(first, again)
    assert not np.allclose(first, through(ChannelConfig(doppler_hz=100, seed=4), 1.0), atol=0.1)


def lose(seed: int, count: int = 400, **settings: Any) -> tuple[list[bytes], PacketLoss]:
    top = gr.top_block()
    probe = Probe()
    loss = PacketLoss(ChannelConfig(seed=seed, **settings))
    top.msg_connect((probe, "pdus"), (loss, "pdus"))
    top.msg_connect((loss, "pdus"), (probe, "pdus"))
    top.start()
    for number in range(count):
        probe.post(number.to_bytes(2, "big"))
    wait_for(lambda: loss.received == count)
    wait_for(lambda: probe.handled + loss.dropped.total() == count)
    top.stop()
    top.wait()
    return probe.packets, loss


def test_losses_are_counted_and_repeat_with_the_seed() -> None:
    first, loss = lose(1, packet_loss=0.3)
    assert len(first) + loss.dropped["packet_loss"] == 400
    assert 60 < loss.dropped["packet_loss"] < 180
    assert lose(1, packet_loss=0.3)[0] == first
    assert lose(2, packet_loss=0.3)[0] != first


def test_none_or_all() -> None:
    assert len(lose(1, 50)[0]) == 50
    assert lose(1, 50, packet_loss=1.0)[0] == []


def test_an_unplugged_link_passes_nothing() -> None:
    packets, loss = lose(1, 50, outages=((0.0, 3600.0),))
    assert packets == []
    assert loss.dropped == {"outages": 50}
