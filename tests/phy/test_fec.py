"""Codes: what goes in comes out, errors are corrected, and it is worth decibels on every PHY."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from gr_ros2.core.errors import BackendMissingError
from gr_ros2.phy import PHY
from gr_ros2.phy.fec import Codes
from gr_ros2.phy.measure import deliver, pdr, record
from gr_ros2.phy.theory import coded_success, half_point
from gr_ros2.settings.config import ChannelConfig

CODES = ("cc", "ldpc", "polar")


def soft(bits: np.ndarray) -> np.ndarray:
    return np.asarray(4 * (2.0 * bits - 1), np.float32)


def bits(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 2, count).astype(np.uint8)


@pytest.mark.parametrize("count", [144, 152, 153, 544, 902, 903, 1281, 32792])
@pytest.mark.parametrize("name", ["none", *CODES])
def test_any_number_of_bits(name: str, count: int) -> None:
    code = Codes(name).of(count)
    data = bits(count)
    sent = code.encode(data)
    assert len(sent) == code.coded_bits
    assert set(sent) == {0, 1}
    assert np.array_equal(code.decode(soft(sent)), data)


@pytest.mark.parametrize("name", CODES)
def test_a_burst_of_errors_is_corrected(name: str) -> None:
    code = Codes(name).of(544)
    data = bits(544)
    received = soft(code.encode(data))
    received[300:340] = 0  # a fade
    received[500:510] *= -1
    assert np.array_equal(code.decode(received), data)


@pytest.mark.parametrize("packet_len", [50, 67, 84, 101, 118])
def test_carriers_that_fade_in_each_symbol_are_corrected_at_any_length(packet_len: int) -> None:
    """At these lengths many a bit was on the carrier of one that follows soon."""
    carriers = 204
    code = Codes("cc", carriers=(carriers, 1)).of(8 * (packet_len + 4))
    data = bits(code.bits)
    for seed in range(10):
        faded = np.random.default_rng(seed).permutation(carriers)[: carriers // 4]
        received = soft(code.encode(data))
        received[np.isin(np.arange(len(received)) % carriers, faded)] = 0
        assert np.array_equal(code.decode(received), data)


@pytest.mark.parametrize("name", CODES)
def test_certainty_beyond_measure_does_no_harm(name: str) -> None:
    code = Codes(name).of(544)
    data = bits(544)
    assert np.array_equal(code.decode(soft(code.encode(data)) * np.float32(1e6)), data)


@pytest.mark.parametrize(("name", "at_db"), [("cc", 4.0), ("ldpc", 2.5), ("polar", 3.0)])
def test_packets_of_64_bytes_arrive_at_an_eb_n0_that_loses_all_without_a_code(name: str, at_db: float) -> None:
    def share(which: str) -> float:
        code = Codes(which).of(544)
        energy = 10 ** (at_db / 10) * code.bits / code.coded_bits
        draw, right = np.random.default_rng(1), 0
        for seed in range(60):
            data = bits(544, seed)
            received = 2.0 * code.encode(data) - 1 + draw.standard_normal(code.coded_bits) / np.sqrt(2 * energy)
            right += np.array_equal(code.decode((4 * energy * received).astype(np.float32)), data)
        return right / 60

    assert share("none") < 0.05
    assert share(name) > 0.95


GAINS = [("ofdm", "cc", 5), ("ofdm", "polar", 5), ("gfsk", "cc", 5), ("psk", "polar", 5), ("lora", "cc", 2.3)]


@pytest.mark.parametrize(("name", "code", "gain_db"), GAINS)
def test_the_gain_on_the_air(name: str, code: str, gain_db: float) -> None:
    """At an SNR so far below the one where half of the uncoded packets arrive, more than half of the coded ones do."""
    plain, coded = (PHY.load(name)(64, 1e6, fec=which) for which in ("none", code))
    count = 30 if name == "lora" else 80
    channel = ChannelConfig(snr_db=half_point(plain.computed_pdr) - gain_db, seed=3)
    assert pdr(coded, record(coded, count), channel) > 0.5
    assert pdr(plain, record(plain, count), channel) < 0.1


@pytest.mark.parametrize("code", CODES)
@pytest.mark.parametrize("name", ["ofdm", "psk", "gfsk"])
def test_a_coded_packet_in_noise_comes_once(name: str, code: str) -> None:
    phy: Any = PHY.load(name)(64, 1e6, fec=code)
    recording = record(phy, 30)
    assert deliver(phy, recording, ChannelConfig(snr_db=5, seed=1)) == recording.packets


def test_the_bound_is_that_of_the_literature() -> None:
    """Rate 1/2, 1024 bits, BPSK: half of the blocks at about 0.3 dB Eb/N0 beyond the capacity's 0.19 dB."""
    points = np.array([-1, 1], np.complex64)
    at = half_point(lambda db: coded_success(points, 10 ** (db / 10), 512, 1024)) + 3.01
    assert at == pytest.approx(0.19, abs=0.2)


def test_missing_matrices_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gnuradio.gr.prefix", lambda: "/nowhere")
    with pytest.raises(BackendMissingError, match=r"/nowhere/share/gnuradio/fec/ldpc"):
        Codes("ldpc").of(544)
