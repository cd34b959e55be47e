"""Words that say lengths: far apart, heard in noise, and the headers of GNU Radio's OFDM frames."""

from __future__ import annotations

import random
from typing import Any

import numpy as np
import pytest

from gr_ros2.phy import PHY
from gr_ros2.phy.length_word import LENGTHS, LengthWord, header_bits, header_crc
from gr_ros2.phy.lora import telling
from gr_ros2.phy.ofdm_layout import OfdmLayout
from gr_ros2.phy.theory import half_point
from tests.phy.test_burst import noise, received_by

EVERY = range(1, LENGTHS)


def distances(bits: np.ndarray) -> np.ndarray:
    signs = 1 - 2.0 * bits.astype(np.float32)
    apart = (bits.shape[1] - signs @ signs.T) / 2
    np.fill_diagonal(apart, bits.shape[1])
    return apart


def test_any_two_words_differ_in_8_bits() -> None:
    assert distances(LengthWord(EVERY, EVERY).bits).min() == 8


def test_headers_of_frames_that_are_filled_up_differ_in_4_bits() -> None:
    from gr_ros2.phy.burst import Frames
    from gr_ros2.phy.ofdm_modem import OfdmModem

    modem = OfdmModem(Frames(4095, multiple=3, order="little"), OfdmLayout(64, 16, "64qam", False), None)
    assert modem._word is not None
    assert distances(modem._word.bits).min() >= 4


def test_every_length_is_read_as_it_was_said() -> None:
    word = LengthWord(EVERY, EVERY)
    for length in (*range(1, 20), *range(20, LENGTHS, 97), LENGTHS - 1):
        soft = word.word(length) * np.float32(2) - 1
        assert word.read(soft) == word.read_header(soft) == length


def test_a_header_that_counts_is_one_of_the_longest_frame() -> None:
    word = LengthWord(range(1, 65), range(5, 69))
    for number in (0, 1, 2, 77, 4095):
        (bits,) = header_bits([68], np.array([number]))
        assert word.read_header(bits * np.float32(2) - 1) == 64
    assert header_crc(68, 1) != header_crc(68, 0)


@pytest.mark.parametrize("chips", [128, 512, 4096])
def test_chirps_that_tell_lengths_differ_in_three_of_four(chips: int) -> None:
    places = telling(range(1, 4096), chips)
    draw = random.Random(1)
    for row in [0, 1, 127, 128, 4094, *(draw.randrange(4095) for _ in range(200))]:
        alike = (places == places[row]).sum(axis=1)
        alike[row] = 0
        assert alike.max() <= 1


@pytest.mark.parametrize(
    ("name", "fec", "beyond_db"),
    [
        *((name, "none", 0.0) for name in ("ofdm", "psk", "gfsk")),
        *((name, "cc", 2.3) for name in ("ofdm", "psk", "gfsk")),
    ],
)
def test_the_length_is_heard_where_half_of_the_packets_are(name: str, fec: Any, beyond_db: float) -> None:
    """``beyond_db``: what the code is beyond an ideal one, for which half points are computed."""
    phy = PHY.load(name)(64, 1e6, fec=fec, kernels="numpy")
    draw, modem, snr_db = random.Random(2), phy.modem, half_point(phy.computed_pdr) + beyond_db
    heard, wrong = 0, 0
    for number in range(60):
        burst = modem.modulate(draw.randbytes(64))
        samples = np.concatenate((np.zeros(300), burst, np.zeros(300)))
        samples = samples + noise(len(samples), snr_db, number) * phy.burst_power() ** 0.5
        stream = received_by(phy, samples)
        start = modem.find(stream).start
        if start is not None:
            heard += 1
            wrong += modem.read(stream, start).length != 64
    assert heard > 30
    assert wrong <= 0.05 * heard
