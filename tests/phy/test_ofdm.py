"""The `ofdm` PHY: every packet length passes, airtime and power are what is claimed, and nothing needs a push."""

from __future__ import annotations

import os
import random
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gnuradio import blocks, gr
from scipy.signal import resample_poly

from gr_ros2.core.errors import ConfigError
from gr_ros2.phy.burst import BurstReceiver
from gr_ros2.phy.measure import deliver, modulated, record
from gr_ros2.phy.ofdm import OfdmPhy
from gr_ros2.phy.ofdm_stock import SPINNING_NICE
from gr_ros2.settings.config import ChannelConfig
from tests.gr.probe import Probe
from tests.waiting import wait_for

STOCK = {"detection_threshold": "stock"}


class Loop:
    """Transmitter and receiver back to back, the samples between them kept."""

    def __init__(self, phy: OfdmPhy) -> None:
        self.probe = Probe()
        self.top = gr.top_block()
        self.transmitter = phy.transmitter()
        self.samples = blocks.vector_sink_c()
        self.receiver = phy.receiver()
        self.top.msg_connect((self.probe, "pdus"), (self.transmitter, "pdus"))
        self.top.connect(self.transmitter, self.samples)
        self.top.connect(self.transmitter, self.receiver)
        self.top.msg_connect((self.receiver, "pdus"), (self.probe, "pdus"))

    def __enter__(self) -> Loop:
        self.top.start()
        return self

    def __exit__(self, *_error: object) -> None:
        self.top.stop()
        self.top.wait()
        self.transmitter.release()
        self.receiver.release()


def packets(packet_len: int, count: int) -> list[bytes]:
    source = random.Random(packet_len)
    return [source.randbytes(packet_len) for _ in range(count)]


@pytest.mark.parametrize("modulation", ["bpsk", "qpsk"])
@pytest.mark.parametrize("packet_len", [14, 15, 64, 220, 1024, 1500, 4091, 4092, 4095])
def test_every_length_passes_the_stock_blocks_back_to_back_and_the_air_is_as_long_and_as_strong_as_claimed(
    packet_len: int, modulation: str
) -> None:
    phy = OfdmPhy(packet_len, 1e6, payload_modulation=modulation, **STOCK)
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


@pytest.mark.parametrize("options", [{}, STOCK], ids=str)
def test_a_single_packet_comes_out_by_itself(options: dict[str, Any]) -> None:
    with Loop(OfdmPhy(64, 1e6, **options)) as loop:
        for number, packet in enumerate(packets(64, 20), start=1):
            loop.probe.post(packet)
            wait_for(lambda number=number: loop.probe.handled >= number, "the packet just sent")


def test_the_smallest_gap_that_frees_the_last_packet() -> None:
    with Loop(OfdmPhy(64, 1e6, gap=112, **STOCK)) as loop:
        loop.probe.post(packets(64, 1)[0])
        wait_for(lambda: loop.probe.handled, "the packet")


@pytest.mark.parametrize("options", [{}, STOCK], ids=str)
def test_scrambling(options: dict[str, Any]) -> None:
    with Loop(OfdmPhy(64, 1e6, scramble=True, **options)) as loop:
        loop.probe.post(bytes(64))
        wait_for(lambda: loop.probe.handled, "the packet")
    assert loop.probe.packets == [bytes(64)]


@pytest.mark.parametrize(("modulation", "samples"), [("bpsk", 1200), ("qpsk", 720)])
@pytest.mark.parametrize(("options", "gap"), [({}, 32), (STOCK, 160)])
def test_airtime_of_64_bytes(modulation: str, samples: int, options: dict[str, Any], gap: int) -> None:
    phy = OfdmPhy(64, 100e3, payload_modulation=modulation, **options)
    assert phy.airtime_samples() == samples + gap
    assert phy.airtime() == pytest.approx((samples + gap) / 100e3)


@pytest.mark.parametrize("scramble", [False, True])
@pytest.mark.parametrize("fft_len", [64, 512])
@pytest.mark.parametrize("modulation", ["bpsk", "qpsk", "8psk", "16qam", "64qam"])
def test_ours_and_the_stock_blocks_understand_each_other_and_send_the_same(
    modulation: str, fft_len: int, scramble: bool
) -> None:
    settings = {"payload_modulation": modulation, "fft_len": fft_len, "scramble": scramble, "gap": 2000}
    own, stock = OfdmPhy(65, 1e6, **settings), OfdmPhy(65, 1e6, **settings, **STOCK)
    fixed = OfdmPhy(65, 1e6, **settings, lengths="fixed")
    ours, theirs = record(fixed, 3), record(stock, 3)
    first = own.airtime_samples()  # the header counts frames, ours does not
    assert np.allclose(ours.samples[:first], theirs.samples[:first], atol=1e-4)
    for one, other in ((fixed, theirs), (stock, ours), (own, theirs), (stock, record(own, 3))):
        assert deliver(one, other, ChannelConfig()) == ours.packets


@pytest.mark.parametrize("modulation", ["bpsk", "16qam"])
def test_the_stock_blocks_understand_packets_of_any_length(modulation: str) -> None:
    settings = {"payload_modulation": modulation, "gap": 2000}
    sent = [bytes([length]) * length for length in (13, 64, 1, 40)]
    recording = modulated(OfdmPhy(64, 1e6, **settings), sent)
    assert deliver(OfdmPhy(64, 1e6, **settings, **STOCK), recording, ChannelConfig()) == sent


@pytest.mark.parametrize(
    "chosen",
    [
        {"carriers": 29, "pilots": (-20, -5, 12, 28)},
        {"pilots": (-26, 26)},
        {"carriers": 27, "pilots": (-27, -26, 9, 27)},
    ],
    ids=str,
)
def test_other_carriers_and_pilots_are_those_of_the_stock_blocks_too(chosen: dict[str, Any]) -> None:
    settings = {**chosen, "payload_modulation": "qpsk", "gap": 2000}
    own, stock = OfdmPhy(65, 1e6, **settings), OfdmPhy(65, 1e6, **settings, **STOCK)
    ours, theirs = record(own, 3), record(stock, 3)
    assert own.frame_bits() == OfdmPhy(65, 1e6, payload_modulation="qpsk").frame_bits()
    assert own.airtime_samples() <= OfdmPhy(65, 1e6, payload_modulation="qpsk", gap=2000).airtime_samples()
    head = 3 * 80  # sync words, and the header, in which ours say the length with the number
    alike = np.isclose(ours.samples, theirs.samples, atol=1e-4)[: own.airtime_samples()]
    assert np.all(alike[: head - 80]) and np.all(alike[head:])
    assert deliver(own, theirs, ChannelConfig()) == ours.packets
    assert deliver(stock, ours, ChannelConfig()) == ours.packets


@pytest.mark.parametrize("carriers", [-4.7, -3.0, -0.9, 0.5, 1.0, 2.3, 4.7])
def test_a_carrier_offset_of_up_to_four_carriers(carriers: float) -> None:
    phy = OfdmPhy(64, 1e6, payload_modulation="qpsk")
    recording = record(phy, 20)
    channel = ChannelConfig(snr_db=15, frequency_offset=carriers / 64, seed=1)
    assert deliver(phy, recording, channel) == recording.packets


@pytest.mark.parametrize("epsilon", [0.9999, 1.0001])
def test_clocks_that_differ_by_100_ppm_through_the_longest_packet(epsilon: float) -> None:
    phy = OfdmPhy(4095, 1e6, payload_modulation="qpsk")
    recording = record(phy, 4)
    assert deliver(phy, recording, ChannelConfig(snr_db=20, epsilon=epsilon, seed=1)) == recording.packets


@pytest.mark.parametrize("modulation", ["bpsk", "16qam"])
def test_echoes_before_and_after_the_strongest_path(modulation: str) -> None:
    phy = OfdmPhy(64, 1e6, payload_modulation=modulation)
    recording = record(phy, 30)
    taps = (0.3, 0, 1, 0.2j, 0, 0, 0, 0, -0.3)
    assert deliver(phy, recording, ChannelConfig(snr_db=30, taps=taps, seed=1)) == recording.packets


@pytest.mark.parametrize("compiled", [True, False])
@pytest.mark.parametrize("seed", range(3))
def test_a_room_in_which_no_path_holds_a_fifth_of_the_energy(seed: int, compiled: bool) -> None:
    phy = OfdmPhy(64, 3000, payload_modulation="bpsk", fec="cc", fft_len=512, cp_len=256, scramble=True)
    rng, said = np.random.default_rng(seed), packets(64, 4)
    pause = np.zeros(phy.gap + 2000, np.complex64)
    sent = np.concatenate([part for packet in said for part in (pause, phy.modem.modulate(packet))] + [pause])
    at = np.arange(1200) / 3000  # RT60 of .4 s, and no direct sound
    room = (rng.normal(size=1200) + 1j * rng.normal(size=1200)) * 10 ** (-3 * at / 0.4)
    room /= np.linalg.norm(room)
    assert (np.abs(room) ** 2).max() < 0.2
    noise = rng.normal(size=(2, len(sent) + 1199)) * np.sqrt(np.mean(np.abs(sent) ** 2) / 2) * 10 ** (-20 / 20)
    heard = (np.convolve(sent, room) + noise[0] + 1j * noise[1]).astype(np.complex64)
    receiver = (phy.running_modem if compiled else phy.modem).receiver()
    came = [found.data for first in range(0, len(heard), 4096) for found in receiver.feed(heard[first : first + 4096])]
    assert came == said


def driven(sent: np.ndarray, pace: float) -> np.ndarray:
    """The same burst on a clock that is slower by so much, or from a robot that comes nearer as it sounds."""
    wide = resample_poly(sent, 4, 1, window=("kaiser", 9.0))
    at = 4 * (1 + pace) * np.arange(int((len(sent) - 2) / (1 + pace)))
    places = np.arange(len(wide))
    turned = np.exp(1j * 0.0035 * pace / 2.9e-3 * np.arange(len(at)))  # the carrier is driven, too
    return np.asarray((np.interp(at, places, wide.real) + 1j * np.interp(at, places, wide.imag)) * turned)


@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize("ppm", [300, -300, 2900, -2900, 3200])
@pytest.mark.parametrize("size", [256, 512])
def test_sound_from_a_robot_that_drives_arrives(size: int, ppm: float, compiled: bool) -> None:
    """In a room whose echoes are as loud as the direct sound, as the presets `sound` and `hall` send it."""
    phy = OfdmPhy(64, 8e3, fft_len=size, cp_len=size // 2, fec="cc", scramble=True)
    rng, said = np.random.default_rng(size), packets(64, 4)
    pause = np.zeros(phy.gap + 900, np.complex64)
    sent = np.concatenate([part for packet in said for part in (pause, phy.modem.modulate(packet))] + [pause])
    at = np.arange(size // 2)
    room = rng.normal(size=(2, len(at))) * 10 ** (-3 * at / size)
    room = (room[0] + 1j * room[1]) / np.linalg.norm(room)
    room[0] += 1
    heard = driven(np.convolve(sent, room), ppm * 1e-6)
    noise = rng.normal(size=(2, len(heard))) * np.sqrt(np.mean(np.abs(sent) ** 2) / 2) * 10 ** (-20 / 20)
    heard = (heard + noise[0] + 1j * noise[1]).astype(np.complex64)
    receiver = (phy.running_modem if compiled else phy.modem).receiver()
    came = [found.data for first in range(0, len(heard), 4096) for found in receiver.feed(heard[first : first + 4096])]
    assert came == said


def test_noise_and_tones_are_no_burst() -> None:
    phy = OfdmPhy(64, 1e6, fft_len=256, cp_len=128)
    rng, at = np.random.default_rng(1), np.arange(1 << 20)
    noise = (rng.normal(size=1 << 20) + 1j * rng.normal(size=1 << 20)).astype(np.complex64)
    tones = sum(np.exp(1j * (step * at + step)) for step in (0.1, 0.73, 2.2, -1.3)) * 10
    for samples in (noise, noise + tones.astype(np.complex64)):
        assert phy.running_modem.find(samples).start is None


def test_nothing_is_lost_without_noise_wherever_a_packet_begins() -> None:
    """Single packets, each after any length of silence: the stock receiver at a low threshold loses 1 in 3000."""
    phy = OfdmPhy(64, 1e6)
    draw = random.Random(5)
    receiver = BurstReceiver(phy.modem)
    for packet in packets(64, 1500):
        silence = np.zeros(draw.randrange(1, 400), np.complex64)
        burst = phy.modem.modulate(packet)
        assert [heard.data for heard in receiver.feed(np.concatenate((silence, burst)))] == [packet]
    assert receiver.damaged == 0


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"gap": 0}, "gap = 0"),
        ({"payload_modulation": "qam64"}, "payload_modulation = 'qam64'"),
        ({"colour": 1}, "unknown key colour"),
        ({**STOCK, "gap": 111}, "gap = 111"),
        ({**STOCK, "fec": "cc"}, "fec = 'cc'"),
        ({"fec": "turbo"}, "fec = 'turbo'"),
        ({"carriers": 32}, "carriers = 32: at most 31"),
        ({"carriers": 17, "pilots": (-9, -3, 3, 9)}, "30 carriers are left for data"),
        ({"carriers": 17}, r"carriers = 17: unless set, pilots are \(-21, -7, 7, 21\); give pilots too, at most 17"),
        ({"pilots": (*range(-26, 0), *range(1, 27))}, "0 carriers are left for data.*fewer pilots"),
        ({"pilots": ()}, r"pilots = \(\): at least two"),
        ({"pilots": (0, 7)}, "pilots: 0 is not"),
        ({"pilots": (-27, 7)}, "pilots: -27 is not one of the carriers 1 to 26 either side"),
        ({"pilots": (7, 7)}, r"pilots = \(7, 7\)"),
    ],
)
def test_a_wrong_option_is_named(options: dict[str, Any], named: str) -> None:
    with pytest.raises(ConfigError, match=named):
        OfdmPhy(64, 1e6, **options)


@pytest.mark.parametrize("sample_rate", [0.0, -1.0, float("nan")])
def test_a_sample_rate_is_needed(sample_rate: float) -> None:
    with pytest.raises(ConfigError, match="sample_rate"):
        OfdmPhy(64, sample_rate)


def test_the_spinning_thread_steps_back_behind_the_others() -> None:
    phy = OfdmPhy(64, 1e6, **STOCK)
    with Loop(phy) as loop:
        phy.prefer_latency()
        names = {int(task.name): (task / "comm").read_text() for task in Path("/proc/self/task").iterdir()}
        nice = min(19, os.getpriority(os.PRIO_PROCESS, 0) + SPINNING_NICE)
        behind = [task for task in names if os.getpriority(os.PRIO_PROCESS, task) == nice]
        assert [names[task][:10] for task in behind] == ["header_pay"], names
        loop.probe.post(bytes(64))
        wait_for(lambda: loop.probe.handled, "the packet")


@pytest.mark.parametrize("options", [{}, STOCK], ids=str)
def test_numpys_generator_is_left_alone(options: dict[str, Any]) -> None:
    np.random.seed(7)
    expected = np.random.random()
    np.random.seed(7)
    phy = OfdmPhy(64, 1e6, **options)
    phy.transmitter()
    phy.receiver()
    assert np.random.random() == expected
