"""What every PHY with samples promises, run over every row of the table and the settings that change its samples."""

from __future__ import annotations

import random
from typing import Any

import numpy as np
import pmt
import pytest
from gnuradio import blocks, gr

from gr_ros2.core.errors import BackendMissingError, ConfigError
from gr_ros2.phy import PHY, Phy
from gr_ros2.phy.base import LENGTH_TAG
from gr_ros2.phy.measure import deliver, modulated, pdr, record
from gr_ros2.phy.tap import SYMBOLS_SHOWN
from gr_ros2.phy.theory import half_point
from gr_ros2.settings.config import ChannelConfig
from tests.gr.probe import Probe
from tests.phy.loopback import Loopback
from tests.waiting import wait_for

WITH_SAMPLES = [name for name in PHY if PHY.load(name).has_samples]
SETTINGS: list[tuple[str, dict[str, Any]]] = [
    *((name, {}) for name in WITH_SAMPLES),
    *(("ofdm", {"payload_modulation": name}) for name in ("qpsk", "8psk", "16qam", "64qam")),
    ("ofdm", {"fft_len": 256, "scramble": True}),
    ("ofdm", {"fft_len": 512, "cp_len": 256, "payload_modulation": "64qam"}),
    ("ofdm", {"gap": 16, "fec": "cc"}),
    ("ofdm", {"carriers": 30, "pilots": (-25, -9, 9, 25)}),
    ("ofdm", {"carriers": 20, "pilots": (-10, 10), "detection_threshold": "stock"}),
    ("ofdm", {"detection_threshold": "stock", "gap": 112}),
    ("gfsk", {"sps": 2, "bt": 0.3, "gap": 16}),
    ("gfsk", {"sps": 8, "bt": 1.0, "fec": "polar"}),
    ("psk", {"modulation": "bpsk", "sps": 2, "gap": 16}),
    ("psk", {"modulation": "8psk", "rolloff": 0.2}),
    ("psk", {"modulation": "qpsk", "sps": 8, "rolloff": 1.0}),
    ("psk", {"fec": "ldpc"}),
    ("lora", {"coding_rate": 1, "gap": 16}),
    ("lora", {"spreading_factor": 9, "coding_rate": 3}),
    ("lora", {"coding_rate": 1, "fec": "cc"}),
    ("wifi", {"encoding": "bpsk-3/4", "equalizer": "lms"}),
    ("wifi", {"encoding": "qpsk-3/4", "gap": 1000, "equalizer": "sta"}),
    ("wifi", {"encoding": "16qam-1/2", "channel_hz": 5.89e9}),
    ("wifi", {"encoding": "64qam-3/4"}),
    ("lora", {"implementation": "lora_sdr"}),
    ("lora", {"implementation": "lora_sdr", "spreading_factor": 9, "coding_rate": 3}),
    ("lora", {"implementation": "lora_sdr", "spreading_factor": 8, "coding_rate": 1, "ldro": True, "gap": 48}),
]
LENGTHS = (14, 15, 64, 4095)
MORE_LENGTHS = (16, 220, 1500)
"""Of the settings that each PHY has by itself."""
LONGEST = {"lora_sdr": 251, "wifi": 1492}
"""By implementation or name."""
IDS = ["-".join([name, *(f"{key}={value}" for key, value in options.items())]) for name, options in SETTINGS]
IN_NOISE = [
    *((name, {}) for name in WITH_SAMPLES),
    *(("ofdm", {"payload_modulation": name}) for name in ("qpsk", "8psk", "16qam", "64qam")),
    ("psk", {"modulation": "bpsk"}),
    ("psk", {"modulation": "8psk"}),
    ("lora", {"implementation": "lora_sdr"}),
    *(("wifi", {"encoding": name}) for name in ("bpsk-3/4", "qpsk-1/2", "16qam-3/4", "64qam-2/3")),
]
_LONG = 10_000
"""Samples of a packet from which on fewer packets have to do."""
CASES = [
    pytest.param(name, options, packet_len, id=f"{packet_len}-{about}")
    for (name, options), about in zip(SETTINGS, IDS, strict=True)
    for packet_len in (*LENGTHS, *(() if options else MORE_LENGTHS))
    if packet_len <= LONGEST.get(options.get("implementation", name), max(LENGTHS))
    and not (name == "lora" and options and packet_len == max(LENGTHS))  # as by default, for seconds of chirps
]


def make(name: str, options: dict[str, Any], packet_len: int = 64) -> Phy:
    if options.get("implementation") == "lora_sdr":
        pytest.importorskip("gnuradio.lora_sdr", reason="gr-lora_sdr is not installed")
    try:
        PHY.modules(name)
    except BackendMissingError as error:
        pytest.skip(str(error))
    phy: Phy = PHY.load(name)(packet_len, 1e6, **options)
    return phy


@pytest.mark.parametrize(("name", "options", "packet_len"), CASES)
def test_nothing_is_lost_back_to_back_and_the_air_is_as_long_and_strong_as_claimed(
    name: str, options: dict[str, Any], packet_len: int
) -> None:
    phy = make(name, options, packet_len)
    count = 2 if phy.airtime_samples() > 300_000 else 5 if packet_len > 1000 else 12
    recording = record(phy, count)
    samples = recording.samples
    assert len(samples) == count * phy.airtime_samples()
    power = np.mean(np.abs(samples) ** 2) * phy.airtime_samples() / (phy.airtime_samples() - phy.gap)  # type: ignore[attr-defined]
    assert power == pytest.approx(phy.burst_power(), rel=0.09 if packet_len < 1000 else 0.04)
    assert np.all(samples.reshape(count, -1)[:, -phy.gap :] == 0)  # type: ignore[attr-defined]
    assert deliver(phy, recording, ChannelConfig()) == recording.packets


@pytest.mark.parametrize(("name", "options"), SETTINGS, ids=IDS)
def test_packets_take_the_air_that_their_bytes_need(name: str, options: dict[str, Any]) -> None:
    phy = make(name, options)
    if not phy.any_length:
        assert phy.airtime_samples(1) == phy.airtime_samples()
        return
    draw = random.Random(7)
    lengths = [1, 2, 3, 62, 63, 64, *(draw.randrange(1, 65) for _ in range(6)), 64, 1]
    recording = modulated(phy, [draw.randbytes(length) for length in lengths])
    assert len(recording.samples) == sum(phy.airtime_samples(length) for length in lengths)
    assert deliver(phy, recording, ChannelConfig(snr_db=30, seed=1)) == recording.packets
    assert phy.airtime_samples(1) <= phy.airtime_samples(13) <= phy.airtime_samples(64) == phy.airtime_samples()
    phy.pad_all()
    assert not phy.any_length
    assert phy.airtime_samples(1) == phy.airtime_samples()


@pytest.mark.parametrize("name", WITH_SAMPLES)
def test_bursts_that_differ_in_length_tell_it_in_a_tag(name: str) -> None:
    phy = make(name, {})
    assert phy.any_length
    samples = [phy.airtime_samples(length) for length in (64, 1, 30, 64)]
    graph, source, transmitter, sink = gr.top_block(), Probe(), phy.transmitter(), blocks.vector_sink_c()
    graph.connect(transmitter, sink)
    graph.msg_connect(source, "pdus", transmitter, "pdus")
    graph.start()
    for length in (64, 1, 30, 64):
        source.post(bytes(length))
    wait_for(lambda: sink.nitems_read(0) == sum(samples), "every burst")
    graph.stop()
    graph.wait()
    begins = [0, *np.cumsum(samples[:-1]).tolist()]
    tags = [(tag.offset, pmt.symbol_to_string(tag.key), pmt.to_python(tag.value)) for tag in sink.tags()]
    assert tags == [(begin, LENGTH_TAG, count) for begin, count in zip(begins, samples, strict=True)]


@pytest.mark.parametrize("name", WITH_SAMPLES)
def test_lengths_that_are_fixed_take_no_other_packet(name: str) -> None:
    phy = make(name, {"lengths": "fixed"})
    assert not phy.any_length
    assert phy.airtime_samples(13) == phy.airtime_samples() <= make(name, {}).airtime_samples()
    recording = record(phy, 5)
    assert deliver(phy, recording, ChannelConfig()) == recording.packets


@pytest.mark.parametrize(("name", "options"), SETTINGS, ids=IDS)
def test_a_single_packet_comes_out_by_itself(name: str, options: dict[str, Any]) -> None:
    source, sink = Probe(), Probe()
    draw = random.Random(1)
    with Loopback(make(name, options), source, sink) as link:
        for number in range(1, 6):
            source.post(draw.randbytes(64))
            wait_for(lambda number=number: sink.handled == number, "the packet just sent")
        assert link.radio.counts().transmitted == 5


@pytest.mark.parametrize("name", WITH_SAMPLES)
def test_all_zeros_and_all_ones_pass(name: str) -> None:
    source, sink = Probe(), Probe()
    sent = [bytes(64), b"\xff" * 64] * 5
    with Loopback(make(name, {}), source, sink):
        for packet in sent:
            source.post(packet)
        wait_for(lambda: sink.handled == len(sent), "every packet")
    assert sink.packets == sent


@pytest.mark.parametrize("name", WITH_SAMPLES)
def test_the_symbols_of_the_last_packet_can_be_seen(name: str) -> None:
    source, sink = Probe(), Probe()
    with Loopback(make(name, {}), source, sink, instrumented=True) as link:
        assert link.radio.symbols() is None
        source.post(bytes(range(64)))
        wait_for(lambda: sink.handled == 1, "the packet")
        symbols = link.radio.symbols()
        assert symbols is not None
        assert 100 < len(symbols) <= SYMBOLS_SHOWN
        assert np.abs(np.abs(symbols) - 1).max() <= 0.35


@pytest.mark.parametrize("frequency_offset", [0.0, 0.0025, -0.005])
@pytest.mark.parametrize("name", WITH_SAMPLES)
def test_at_20_db_nothing_is_lost_at_default_settings(name: str, frequency_offset: float) -> None:
    phy = make(name, {})
    recording = record(phy, 200 if phy.airtime_samples() < _LONG else 60)
    channel = ChannelConfig(snr_db=20, frequency_offset=frequency_offset, epsilon=1.00001, seed=1)
    assert deliver(phy, recording, channel) == recording.packets


@pytest.mark.parametrize(("name", "options"), IN_NOISE, ids=str)
def test_half_of_the_packets_arrive_within_2_db_of_the_computed_point(name: str, options: dict[str, Any]) -> None:
    phy = make(name, options)
    recording = record(phy, 200 if phy.airtime_samples() < _LONG else 80)
    middle = half_point(phy.computed_pdr)
    assert pdr(phy, recording, ChannelConfig(snr_db=middle + 2, seed=2)) > 0.5
    assert pdr(phy, recording, ChannelConfig(snr_db=middle - 2, seed=2)) < 0.5


@pytest.mark.parametrize(("name", "options"), SETTINGS, ids=IDS)
def test_the_computed_share_rises_with_snr(name: str, options: dict[str, Any]) -> None:
    phy = make(name, options)
    shares = [phy.computed_pdr(snr_db) for snr_db in range(-40, 41, 2)]
    assert shares == sorted(shares)
    assert shares[0] == pytest.approx(0, abs=1e-3)
    assert shares[-1] == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize(
    ("name", "options", "named"),
    [
        ("gfsk", {"sps": 1}, "sps = 1"),
        ("gfsk", {"bt": 0.1}, "bt = 0.1"),
        ("gfsk", {"gap": 0}, "gap = 0"),
        ("psk", {"modulation": "qam"}, "modulation = 'qam'"),
        ("psk", {"rolloff": 0}, "rolloff = 0"),
        ("psk", {"colour": 1}, "unknown key colour"),
        ("lora", {"spreading_factor": 13}, "spreading_factor = 13"),
        ("lora", {"coding_rate": 0}, "coding_rate = 0"),
        ("ofdm", {"fft_len": 63}, "fft_len = 63"),
        ("ofdm", {"cp_len": 33}, "cp_len = 33"),
        ("ofdm", {"gap": 15}, "gap = 15"),
        ("ofdm", {"detection_threshold": 0.01}, "detection_threshold"),
        ("ofdm", {"detection_threshold": "best"}, "detection_threshold"),
    ],
)
def test_a_setting_out_of_range_is_named(name: str, options: dict[str, Any], named: str) -> None:
    with pytest.raises(ConfigError, match=named):
        make(name, options)


def test_a_lora_burst_that_takes_too_much_memory_is_refused_with_a_remedy() -> None:
    with pytest.raises(ConfigError, match="packet_len = 4095 with spreading_factor = 12"):
        make("lora", {"spreading_factor": 12}, 4095)


@pytest.mark.parametrize("name", WITH_SAMPLES)
def test_a_pdu_that_is_no_packet_is_counted_and_not_sent(name: str) -> None:
    source, sink = Probe(), Probe()
    link = Loopback(make(name, {}), source, sink)
    with link:
        source.post(b"")
        source.post(bytes(65))
        source.post(bytes(64))
        wait_for(lambda: sink.handled == 1, "the right one")
        assert link.radio.counts().transmitted == 1
        assert link.radio._transmitter.refused == 2


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
@pytest.mark.parametrize("name", WITH_SAMPLES)
def test_a_sample_that_is_no_number_costs_packets_and_not_the_receiver(name: str, value: float) -> None:
    phy = make(name, {})
    recording = record(phy, 12)
    recording.samples[3 * phy.airtime_samples() + 100] = value
    arrived = deliver(phy, recording, ChannelConfig())
    assert set(arrived) <= set(recording.packets)
    assert arrived[-4:] == recording.packets[-4:]
