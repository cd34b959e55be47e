"""Path loss, shadowing and Doppler shift against theory: the formulas, and the statistics of what is drawn."""

from __future__ import annotations

import math

import numpy as np
import pytest

from gr_ros2.settings.config import ScenarioChannel
from gr_ros2_lab.medium.propagation import LIGHT_M_S, Shadowing, doppler_hz, path_loss_db, snr_over_db

CARRIER_HZ = 2.4e9


def loss(distances: object, **settings: object) -> list[float]:
    channel = ScenarioChannel(from_="positions", carrier_hz=CARRIER_HZ, **settings)  # type: ignore[arg-type]
    return path_loss_db(channel, np.array(distances, float)).tolist()


def test_free_space_is_that_of_friis() -> None:
    assert loss([1, 10, 1000], model="free_space") == pytest.approx([40.05, 60.05, 100.05], abs=0.01)
    assert loss([0.0, 0.5], model="free_space") == pytest.approx([40.05] * 2, abs=0.01), "nearer than a metre"


@pytest.mark.parametrize("exponent", [2.0, 3.0, 4.0])
def test_log_distance_loses_ten_times_its_exponent_per_decade(exponent: float) -> None:
    near, far, farther = loss([1, 10, 100], exponent=exponent)
    assert near == pytest.approx(loss([1], model="free_space")[0])
    assert far - near == farther - far == pytest.approx(10 * exponent)


def test_two_rays_follow_the_fourth_power_far_away_and_free_space_on_average_near() -> None:
    height = 1.0
    beyond = 4 * math.pi * height**2 * CARRIER_HZ / LIGHT_M_S  # Rappaport, 4.6: the crossover distance
    far = np.array([30, 100, 300]) * beyond
    expected = 40 * np.log10(far) - 40 * math.log10(height)
    assert loss(far, model="two_ray", height_m=height) == pytest.approx(expected.tolist(), abs=0.05)
    near = np.linspace(5, 50, 20_001)
    gain = 10 ** ((np.array(loss(near, model="free_space")) - loss(near, model="two_ray", height_m=5.0)) / 10)
    reflected = near / np.hypot(near, 2 * 5.0)
    assert gain.mean() == pytest.approx((1 + reflected**2).mean(), rel=0.03), "two rays of any phase add their powers"
    assert gain.max() == pytest.approx(4.0, rel=0.05)


def test_noise_follows_from_bandwidth_and_noise_figure() -> None:
    assert snr_over_db(-100.0, 20.0, 6.0, 1e6) == pytest.approx(28.0)
    assert snr_over_db(-100.0, 20.0, 6.0, 2e6) == pytest.approx(28.0 - 3.01, abs=0.01)


def test_the_carrier_rises_by_the_closing_speed_over_the_wavelength() -> None:
    ways = np.array([[10.0, 0.0], [10.0, 0.0], [0.0, -5.0], [3.0, 4.0]])
    velocities = np.array([[-3.0, 0.0], [0.0, 3.0], [0.0, -2.0], [3.0, 4.0]])
    wavelength = LIGHT_M_S / CARRIER_HZ
    expected = [3 / wavelength, 0.0, -2 / wavelength, -5 / wavelength]
    assert doppler_hz(ways, velocities, CARRIER_HZ).tolist() == pytest.approx(expected)


SIGMA_DB, DECORRELATION_M = 6.0, 5.0


def shadowed(ones: object, others: object, fields: int) -> np.ndarray:
    """Shadowing of pairs of places in many independent fields, shape (fields, pairs)."""
    one, other = np.array(ones, float), np.array(others, float)
    apart = np.hypot(*(other - one).T)
    rows = []
    for seed in range(fields):
        field = Shadowing(SIGMA_DB, DECORRELATION_M, seed)
        here, there = field.ends(one), field.ends(other)
        pairs = ((here[0][place], here[1][place]) for place in range(len(one)))
        rows.append(
            [
                field.between(pair, (there[0][[place]], there[1][[place]]), apart[[place]])[0]
                for place, pair in enumerate(pairs)
            ]
        )
    return np.array(rows)


def test_shadowing_has_its_variance_wherever_both_ends_are() -> None:
    """Mean 0, the standard deviation that was set, and the tails of a normal distribution."""
    ones = [[0, 0]] * 5 + [[70, 20]]
    others = [[0.1, 0], [2, 0], [5, 0], [0, 20], [400, 300], [71, 25]]
    drawn = shadowed(ones, others, 3000)
    assert np.abs(drawn.mean(0)).max() < 4 * SIGMA_DB / math.sqrt(3000)
    assert drawn.std(0) == pytest.approx(np.full(6, SIGMA_DB), rel=0.06)
    assert (np.abs(drawn) > SIGMA_DB).mean() == pytest.approx(0.317, abs=0.02)
    assert (np.abs(drawn) > 2 * SIGMA_DB).mean() == pytest.approx(0.0455, abs=0.008)


@pytest.mark.parametrize("way_m", [0.5, 1.0, 2.5, 5.0, 10.0, 20.0])
def test_shadowing_decorrelates_as_gudmundson_says(way_m: float) -> None:
    """e^-(way / decorrelation) for the way of one end, and the product of both where both move."""
    still, moved, both = shadowed([[0, 0], [0, 0], [0, way_m]], [[100, 0], [100 + way_m, 0], [100, way_m]], 3000).T
    one_end = math.exp(-way_m / DECORRELATION_M)
    spread = 4 / math.sqrt(3000)
    assert np.corrcoef(still, moved)[0, 1] == pytest.approx(one_end, abs=spread * (1 - one_end**2) + 0.01)
    assert np.corrcoef(still, both)[0, 1] == pytest.approx(one_end**2, abs=spread * (1 - one_end**4) + 0.01)


def test_both_directions_of_a_pair_are_shadowed_alike() -> None:
    rng = np.random.default_rng(1)
    ones, others = rng.uniform(0, 50, (2, 40, 2))
    assert shadowed(ones, others, 1) == pytest.approx(shadowed(others, ones, 1), abs=1e-4)


def test_one_field_varies_over_a_large_area_as_much_as_it_was_told() -> None:
    rng = np.random.default_rng(2)
    drawn = shadowed(rng.uniform(0, 300, (2000, 2)), rng.uniform(0, 300, (2000, 2)), 1)
    assert drawn.std() == pytest.approx(SIGMA_DB, rel=0.15)
