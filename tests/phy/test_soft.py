"""Constellations: what is mapped is decided again, and soft bits say how sure that is."""

from __future__ import annotations

import numpy as np
import pytest

from gr_ros2.phy.ofdm_layout import BITS, constellation
from gr_ros2.phy.soft import BitOrder, Points, spread_about

NAMES = tuple(BITS)


def points_of(name: str, order: BitOrder = "little") -> Points:
    return Points(constellation(name), order)


@pytest.mark.parametrize("order", ["little", "big"])
@pytest.mark.parametrize("name", NAMES)
def test_bits_come_back_in_their_order(name: str, order: BitOrder) -> None:
    points = points_of(name, order)
    bits = np.random.default_rng(1).integers(0, 2, 12 * BITS[name]).astype(np.uint8)
    sent = points.map(bits)
    assert np.array_equal(points.soft(points.weigh(sent, 0.1)) > 0, bits == 1)
    assert np.array_equal(points.nearest(sent), sent)


def test_what_does_not_fill_a_point_is_filled_with_zeros() -> None:
    points = points_of("64qam")
    assert np.array_equal(points.map(np.array([1], np.uint8)), points.map(np.array([1, 0, 0, 0, 0, 0], np.uint8)))


def test_the_soft_bits_of_bpsk_are_the_log_likelihood_ratios() -> None:
    points = points_of("bpsk")
    received = np.array([0.3 + 0.9j, -1.1], np.complex64)
    assert points.soft(points.weigh(received, 0.5)) == pytest.approx(4 * received.real / 0.5, rel=1e-5)


@pytest.mark.parametrize("name", NAMES)
def test_without_noise_nothing_is_infinite(name: str) -> None:
    points = points_of(name)
    assert np.all(np.isfinite(points.soft(points.weigh(points.points, 0.0))))


@pytest.mark.parametrize("name", NAMES)
def test_what_is_expected_goes_from_the_mean_of_all_to_the_point_itself(name: str) -> None:
    points = points_of(name)
    sure, energy = points.expected(points.weigh(points.points, 1e-3))
    assert np.allclose(sure, points.points, atol=1e-4)
    assert np.allclose(energy, np.abs(points.points) ** 2, atol=1e-4)
    unsure, _ = points.expected(points.weigh(points.points, 1e6))
    assert np.allclose(unsure, 0, atol=1e-3)


def test_gain_and_noise_are_measured() -> None:
    draw = np.random.default_rng(2)
    sent = points_of("qpsk").map(draw.integers(0, 2, 20_000).astype(np.uint8))
    noise = np.sqrt(0.02 / 2) * (draw.standard_normal(len(sent)) + 1j * draw.standard_normal(len(sent)))
    gain, spread = spread_about((0.5 * sent + noise).astype(np.complex64), sent)
    assert gain == pytest.approx(0.5, rel=0.02)
    assert spread == pytest.approx(0.02, rel=0.05)
