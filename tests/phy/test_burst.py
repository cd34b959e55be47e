"""Burst modems without GNU Radio's scheduler: any cut of the samples, offsets of carrier, timing and clock, damage."""

from __future__ import annotations

import random
import zlib
from typing import Any

import numpy as np
import pytest

from gr_ros2.phy import PHY
from gr_ros2.phy.burst import BurstReceiver, DemodulatedPacket, Frames, Samples, whitening
from gr_ros2.phy.burst_blocks import BurstPhy
from gr_ros2.phy.lora import code_words

NAMES = [name for name in PHY.own if issubclass(PHY.load(name), BurstPhy)]


SETTINGS: list[tuple[str, dict[str, Any]]] = [
    ("ofdm", {}),
    ("gfsk", {}),
    ("gfsk", {"sps": 2, "bt": 0.3, "fec": "cc"}),
    ("psk", {}),
    ("psk", {"modulation": "bpsk", "sps": 2, "rolloff": 0.2}),
    ("psk", {"modulation": "8psk", "fec": "ldpc"}),
]


def bursts(phy: Any, count: int, seed: int = 0) -> tuple[list[bytes], np.ndarray]:
    source = random.Random(seed)
    packets = [source.randbytes(phy.packet_len) for _ in range(count)]
    parts = [np.zeros(400)]
    for packet in packets:
        parts += [phy.modem.modulate(packet), np.zeros(phy.gap)]
    return packets, np.concatenate([*parts, np.zeros(400)])


def data_of(heard: list[DemodulatedPacket]) -> list[bytes]:
    return [packet.data for packet in heard]


def received_by(phy: Any, samples: np.ndarray) -> Samples:
    """Samples as a modem gets them."""
    if phy.receiver_taps is not None:
        samples = np.convolve(samples, phy.receiver_taps)
    return samples.astype(np.complex64)


def listen(phy: Any, samples: np.ndarray, cut: int = 4096) -> tuple[list[bytes], int]:
    """Packets received, and how many bursts were damaged."""
    samples = received_by(phy, samples)
    engine = BurstReceiver(phy.modem)
    packets = [packet for at in range(0, len(samples), cut) for packet in data_of(engine.feed(samples[at : at + cut]))]
    return packets, engine.damaged


def received(phy: Any, samples: np.ndarray, cut: int = 4096) -> list[bytes]:
    return listen(phy, samples, cut)[0]


def noise(count: int, snr_db: float, seed: int = 0) -> np.ndarray:
    draw = np.random.default_rng(seed)
    scale = np.sqrt(10 ** (-snr_db / 10) / 2)
    return np.asarray(scale * (draw.standard_normal(count) + 1j * draw.standard_normal(count)))


def delayed(samples: np.ndarray, delay: float) -> np.ndarray:
    size = 1 << (len(samples) + 64).bit_length()
    spectrum = np.fft.fft(samples, size) * np.exp(-2j * np.pi * np.fft.fftfreq(size) * delay)
    return np.asarray(np.fft.ifft(spectrum)[: len(samples)])


def test_a_frame_is_whitened_and_checked() -> None:
    frame = Frames(20).of(20)
    wrapped = frame.wrap(bytes(20))
    whole = bytes(20) + zlib.crc32(bytes(20)).to_bytes(4, "little")
    assert np.array_equal(np.packbits(wrapped), np.frombuffer(whole, np.uint8) ^ whitening(24))
    soft = 2.0 * wrapped.astype(np.float32) - 1
    assert frame.unwrap(soft) == bytes(20)
    for bit in range(8 * 24):
        damaged = soft.copy()
        damaged[bit] *= -1
        assert frame.unwrap(damaged) is None


def test_whitening_is_pn9() -> None:
    # The first bytes as in data sheets of the CC1101 and of SX127x, whose bit order in a byte is the other way round.
    assert [int(f"{byte:08b}"[::-1], 2) for byte in whitening(5)] == [0xFF, 0xE1, 0x1D, 0x9A, 0xED]


@pytest.mark.parametrize("cut", [1000, 4096, 65536, 1_000_000])
@pytest.mark.parametrize("name", NAMES)
def test_it_does_not_matter_where_the_stream_is_cut(name: str, cut: int) -> None:
    phy = PHY.load(name)(64, 1e6)
    packets, samples = bursts(phy, 12)
    assert received(phy, samples, cut) == packets


@pytest.mark.parametrize("cut", [1, 777, 1_000_000])
@pytest.mark.parametrize("name", NAMES)
def test_packets_of_any_length_come_out_wherever_the_stream_is_cut(name: str, cut: int) -> None:
    phy = PHY.load(name)(64, 1e6)
    draw = random.Random(4)
    packets = [draw.randbytes(draw.randrange(1, 65)) for _ in range(4 if cut == 1 else 20)]
    parts = [part for packet in packets for part in (phy.modem.modulate(packet), np.zeros(phy.gap))]
    assert received(phy, np.concatenate([np.zeros(200), *parts, np.zeros(40)]), cut) == packets


@pytest.mark.parametrize("options", [{"coding_rate": 1, "gap": 16}, {"spreading_factor": 9, "coding_rate": 3}], ids=str)
def test_a_chirp_cut_short_by_the_end_of_the_samples_is_no_loss(options: dict[str, Any]) -> None:
    phy = PHY.load("lora")(64, 1e6, **options)
    packets, samples = bursts(phy, 5)
    draw = random.Random(3)
    for _ in range(20):
        engine, at, got = BurstReceiver(phy.modem), 0, []
        while at < len(samples):
            cut = draw.randrange(1, 6000)
            got += data_of(engine.feed(samples[at : at + cut].astype(np.complex64)))
            at += cut
        assert got == packets


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("delay", [0.0, 0.25, 0.5, 0.75])
def test_bursts_between_samples_with_a_carrier_offset(name: str, delay: float) -> None:
    phy = PHY.load(name)(64, 1e6)
    packets, samples = bursts(phy, 10)
    turned = delayed(samples, delay) * np.exp(2j * np.pi * 0.0125 * np.arange(len(samples)))
    assert received(phy, turned + noise(len(samples), 10)) == packets


@pytest.mark.parametrize("name", NAMES)
def test_a_damaged_burst_is_counted_and_hides_nothing(name: str) -> None:
    phy = PHY.load(name)(64, 1e6)
    packets, samples = bursts(phy, 4)
    start = 400 + phy.airtime_samples()
    samples[start + phy.airtime_samples() // 2 : start + phy.airtime_samples() * 5 // 6] = 0
    got, damaged = listen(phy, samples)
    assert got == [packets[0], *packets[2:]]
    assert damaged >= 1


@pytest.mark.parametrize("snr_db", [None, 20, 40, 60])
@pytest.mark.parametrize(("name", "options"), SETTINGS, ids=str)
def test_the_silence_behind_a_burst_is_not_counted_as_a_damaged_one(
    name: str, options: dict[str, Any], snr_db: float | None
) -> None:
    phy = PHY.load(name)(64, 1e6, gap=2000, **options)
    packets, samples = bursts(phy, 50)
    if snr_db is not None:
        samples = samples + noise(len(samples), snr_db)
    got, damaged = listen(phy, samples)
    assert got == packets
    assert damaged <= (0 if snr_db is None else 1)


@pytest.mark.parametrize("fec", ["none", "ldpc"])
@pytest.mark.parametrize("name", ["gfsk", "psk"])
def test_noise_is_seldom_taken_for_a_burst(name: str, fec: str) -> None:
    phy = PHY.load(name)(64, 1e6, fec=fec)
    assert listen(phy, noise(1_000_000, 0.0))[1] <= 2


@pytest.mark.parametrize("echo", [0.5, 0.5j])
@pytest.mark.parametrize(("name", "options"), SETTINGS[:-1], ids=str)
def test_an_echo_a_symbol_later_hides_no_burst(name: str, options: dict[str, Any], echo: complex) -> None:
    phy = PHY.load(name)(64, 1e6, **options)
    packets, samples = bursts(phy, 10)
    taps = np.zeros(getattr(phy.options, "sps", 4) + 1, complex)
    taps[0], taps[-1] = 1, echo
    assert received(phy, np.convolve(samples, taps) + noise(len(samples) + len(taps) - 1, 25)) == packets


@pytest.mark.parametrize("name", NAMES)
def test_noise_alone_makes_no_packet(name: str) -> None:
    phy = PHY.load(name)(64, 1e6)
    assert received(phy, noise(200_000, 0.0)) == []


def test_the_hamming_codes_are_as_far_apart_as_they_say() -> None:
    for check_bits, distance in ((1, 2), (2, 2), (3, 3), (4, 4)):
        words = code_words(check_bits).tolist()
        assert min((a ^ b).bit_count() for a in words for b in words if a != b) == distance
