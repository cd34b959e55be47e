"""Sync words and points are GNU Radio's, of which this package has forms of its own."""

from __future__ import annotations

import numpy as np
import pytest
from gnuradio import digital
from gnuradio.digital import ofdm_txrx

from gr_ros2.phy.ofdm_layout import OfdmLayout, constellation


@pytest.mark.parametrize("fft_len", [64, 256])
def test_sync_words_are_those_of_ofdm_txrx(fft_len: int) -> None:
    layout = OfdmLayout(fft_len, 16, "qpsk", scramble=False)
    arguments = (fft_len, layout.data, layout.pilots)
    state = np.random.get_state()
    try:
        words = [ofdm_txrx._make_sync_word1(*arguments), ofdm_txrx._make_sync_word2(*arguments)]
    finally:
        np.random.set_state(state)
    assert np.array_equal(layout.sync_words(), words)


@pytest.mark.parametrize(
    ("name", "theirs"), [("bpsk", digital.constellation_bpsk), ("8psk", digital.constellation_8psk)]
)
def test_points_are_those_of_its_constellations(name: str, theirs: type) -> None:
    assert np.allclose(constellation(name), theirs().points(), atol=1e-6)


def test_a_grid_is_gray_coded_and_of_mean_magnitude_1() -> None:
    points = constellation("64qam")
    assert np.abs(points).mean() == pytest.approx(1)
    apart = np.abs(points[:, None] - points)
    nearest = np.min(apart[apart > 0])
    first, second = np.nonzero(np.isclose(apart, nearest))
    assert {int(one ^ other).bit_count() for one, other in zip(first, second, strict=True)} == {1}
