"""The whole link, for every PHY of the table: nothing lost, nothing altered, a clean stop."""

from __future__ import annotations

import random
import threading

import numpy as np
import pytest

from gr_ros2.core.errors import BackendMissingError, ConfigError, PhyError
from gr_ros2.phy import PHY, Phy
from gr_ros2.settings.config import ChannelConfig
from tests.gr.probe import Probe
from tests.phy.loopback import Loopback
from tests.waiting import PATIENCE_S, wait_for

RATE = 5e6
QUICK: dict[str, dict[str, float]] = {"modem": {"bit_rate": 1e6}}
"""Options of PHYs that are slow by default."""


def make(name: str, packet_len: int = 64, sample_rate: float = RATE) -> Phy:
    try:
        phy: Phy = PHY.load(name)(packet_len, sample_rate, **QUICK.get(name, {}))
    except BackendMissingError as error:
        pytest.skip(str(error))
    return phy


def packets(count: int, packet_len: int = 64) -> list[bytes]:
    source = random.Random(count)
    return [source.randbytes(packet_len) for _ in range(count)]


@pytest.mark.parametrize("name", list(PHY))
def test_every_packet_comes_out_unaltered_and_in_order(name: str) -> None:
    source, sink = Probe(), Probe()
    sent = packets(100)
    with Loopback(make(name), source, sink) as link:
        for packet in sent:
            source.post(packet)
        wait_for(lambda: sink.handled == len(sent), "every packet")
        counts = link.radio.counts()
    assert sink.packets == sent
    assert (counts.passed, counts.backlog, counts.transmitted) == (100, 0, 100)
    assert counts.dropped == 0


@pytest.mark.parametrize("name", list(PHY))
def test_packet_loss_is_counted(name: str) -> None:
    source, sink = Probe(), Probe()
    with Loopback(make(name), source, sink, channel=ChannelConfig(packet_loss=0.5, seed=1)) as link:
        for packet in packets(100):
            source.post(packet)
        wait_for(lambda: link.radio.counts().received == 100, "every packet")
        wait_for(lambda: sink.handled == 100 - link.radio.counts().dropped)
        assert 20 < link.radio.counts().dropped < 80
        link.radio.set_packet_loss(0.0)
        source.post(bytes(64))
        wait_for(lambda: sink.packets[-1:] == [bytes(64)])


@pytest.mark.parametrize("frequency_offset", [0.0, 0.005])
def test_a_channel_that_ofdm_is_made_for_loses_nothing(frequency_offset: float) -> None:
    channel = ChannelConfig(snr_db=30, frequency_offset=frequency_offset, taps=(1, 0, 0, 0.4), seed=1)
    source, sink = Probe(), Probe()
    sent = packets(100)
    with Loopback(make("ofdm"), source, sink, channel=channel):
        for packet in sent:
            source.post(packet)
        wait_for(lambda: sink.handled == len(sent), "every packet")
    assert sink.packets == sent


def test_noise_while_running() -> None:
    source, sink = Probe(), Probe()
    with Loopback(make("ofdm"), source, sink, instrumented=True) as link:
        link.radio.set_snr_db(-20.0)
        for packet in packets(20):
            source.post(packet)
        wait_for(lambda: link.radio.counts().transmitted == 20)
        in_noise = sink.handled
        assert in_noise < 20
        link.radio.set_frequency_offset(0.0)
        link.radio.set_snr_db(None)
        # The change reaches the samples a buffer later: the noise source had filled its own.
        for packet in packets(40):
            source.post(packet)
        wait_for(lambda: sink.handled >= in_noise + 20, "packets after the noise")


@pytest.mark.parametrize("name", list(PHY))
def test_an_instrumented_link_loses_nothing_and_can_lose_what_it_is_told(name: str) -> None:
    source, sink = Probe(), Probe()
    sent = packets(100)
    with Loopback(make(name), source, sink, instrumented=True) as link:
        assert link.radio.channel == ChannelConfig()
        for packet in sent:
            source.post(packet)
        wait_for(lambda: sink.handled == len(sent), "every packet")
        link.radio.set_packet_loss(1.0)
        source.post(bytes(64))
        wait_for(lambda: link.radio.counts().dropped == 1, "a packet lost on purpose")
        assert link.radio.channel.packet_loss == 1.0
    assert sink.packets == sent


def test_an_instrumented_link_shows_the_received_signal() -> None:
    source = Probe()
    with Loopback(make("ofdm"), source, Probe(), channel=ChannelConfig(snr_db=30), instrumented=True) as link:
        assert link.radio.samples() is None
        for packet in packets(10):
            source.post(packet)
        wait_for(lambda: link.radio.samples() is not None and link.radio.symbols() is not None, "samples and symbols")
        symbols = link.radio.symbols()
        assert symbols is not None
        # BPSK in little noise: two clouds on the real axis, and the unused carriers of a last symbol.
        assert (abs(symbols.imag) < 0.5).all()
        assert np.median(abs(abs(symbols.real) - 1)) < 0.1
        assert {-1, 1} <= set(np.sign(symbols.real))


def test_a_link_that_is_not_instrumented_shows_nothing() -> None:
    link = Loopback(make("ofdm"), Probe(), Probe())
    assert link.radio.samples() is None
    assert link.radio.symbols() is None


def test_what_has_no_samples_has_no_noise() -> None:
    link = Loopback(make("direct"), Probe(), Probe())
    for change in (
        lambda: link.radio.set_snr_db(10),
        lambda: link.radio.set_frequency_offset(0),
        lambda: link.radio.set_packet_loss(0.1),
    ):
        with pytest.raises(PhyError, match="front_end sim"):
            change()


def test_a_loss_out_of_range_is_refused() -> None:
    with pytest.raises(ConfigError, match="packet_loss"):
        Loopback(make("ofdm"), Probe(), Probe(), instrumented=True).radio.set_packet_loss(2.0)


@pytest.mark.parametrize("name", list(PHY))
def test_it_stops_cleanly_at_any_moment_and_leaves_no_thread(name: str) -> None:
    for rounds in range(4):
        source, sink = Probe(), Probe()
        link = Loopback(make(name, 1492), source, sink)
        link.stop()
        link.start()
        for packet in packets(rounds * 20, 1492):
            source.post(packet)
        link.stop()
        link.stop()
    assert not [thread.name for thread in threading.enumerate() if thread.name.startswith("gr-ros2")]


@pytest.mark.parametrize("name", ["ofdm", "psk"])
def test_a_stop_does_not_wait_for_packets_that_have_yet_to_go_on_the_air(name: str) -> None:
    source, sink = Probe(), Probe()
    link = Loopback(make(name, 1492, sample_rate=10.0), source, sink)
    assert 20 * link.radio.phy.airtime() > 10 * PATIENCE_S
    link.start()
    for packet in packets(20, 1492):
        source.post(packet)
    stopping = threading.Thread(target=link.stop, daemon=True)
    stopping.start()
    wait_for(lambda: not stopping.is_alive(), "the link to stop")
    assert sink.handled < 20
