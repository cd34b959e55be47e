"""The channel: as much noise as asked for, losses that repeat with the seed, changes while running."""

from __future__ import annotations

import pytest

pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")

import numpy as np
from gnuradio import blocks, gr

from gr_ros2.config import ChannelConfig
from gr_ros2.errors import ConfigError
from gr_ros2.phy.channel import Channel, PacketLoss, noise_voltage
from gr_ros2.phy.ofdm import OfdmPhy
from tests.gr.probe import Probe, wait_for

SAMPLES = 200_000


def through(config: ChannelConfig, value: complex = 0j) -> np.ndarray:
    """What a constant becomes on its way through a channel."""
    top = gr.top_block()
    channel = Channel(config, OfdmPhy(64, 1e6))
    sink = blocks.vector_sink_c()
    top.connect(blocks.vector_source_c([value] * SAMPLES), channel, sink)
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


def test_a_change_out_of_range_is_refused() -> None:
    channel = Channel(ChannelConfig(), OfdmPhy(64, 1e6))
    channel.set_snr_db(20.0)
    channel.set_frequency_offset(0.01)
    assert (channel.config.snr_db, channel.config.frequency_offset) == (20.0, 0.01)
    with pytest.raises(ConfigError, match="snr_db"):
        channel.set_snr_db(1000.0)
    with pytest.raises(ConfigError, match="frequency_offset"):
        channel.set_frequency_offset(3.0)


def lose(probability: float, seed: int, count: int = 400) -> tuple[list[bytes], PacketLoss]:
    top = gr.top_block()
    probe = Probe()
    loss = PacketLoss(probability, seed)
    top.msg_connect((probe, "pdus"), (loss, "pdus"))
    top.msg_connect((loss, "pdus"), (probe, "pdus"))
    top.start()
    for number in range(count):
        probe.post(number.to_bytes(2, "big"))
    wait_for(lambda: loss.received == count)
    wait_for(lambda: probe.handled + loss.dropped == count)
    top.stop()
    top.wait()
    return probe.packets, loss


def test_losses_are_counted_and_repeat_with_the_seed() -> None:
    first, loss = lose(0.3, 1)
    assert len(first) + loss.dropped == 400
    assert 60 < loss.dropped < 180
    assert lose(0.3, 1)[0] == first
    assert lose(0.3, 2)[0] != first


def test_none_or_all() -> None:
    assert len(lose(0.0, 1, 50)[0]) == 50
    assert lose(1.0, 1, 50)[0] == []
    with pytest.raises(ConfigError, match="packet_loss"):
        PacketLoss(1.5)
