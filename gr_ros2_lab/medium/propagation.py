"""How much of a signal arrives: path loss, walls, shadowing and Doppler shift, from where both ends are.

Invariants: lengths in m, levels in dB; both directions between two places have the same loss; all functions take many
receivers at a time.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from gr_ros2.core.arrays import Floats
from gr_ros2.settings.config import ScenarioChannel
from gr_ros2_lab.survey.fit import NEAR_M

LIGHT_M_S = 299_792_458.0
THERMAL_DBM_HZ = -174.0
"""Noise of a resistor at 290 K, dBm in a band of 1 Hz."""
_WAVES = 128
"""Sinusoids of which shadowing is made. With 128 the standard deviation of a field over 500 m x 500 m is the set one
within 4 % (one sigma), as measured over 200 fields."""


def snr_over_db(
    gain_db: Floats | float, tx_power_dbm: float, noise_figure_db: Floats | float, bandwidth: float
) -> Floats:
    """SNR in dB for a gain, from the transmitted power, the noise figure and the bandwidth in Hz."""
    return np.asarray(tx_power_dbm + gain_db - THERMAL_DBM_HZ - 10 * math.log10(bandwidth) - noise_figure_db)


def path_loss_db(channel: ScenarioChannel, distances: Floats) -> Floats:
    """Loss over distances in m by the model of a channel.

    ``free_space``: Friis (1946). ``log_distance``: free space up to 1 m, then ``exponent`` (Rappaport, Wireless
    Communications, 4.9). ``two_ray``: the sum of the direct ray and the one that a level ground reflects with a
    coefficient of -1, both antennas at ``height_m`` (ibid., 4.6).
    """
    far = np.maximum(distances, NEAR_M)
    waves = 4 * np.pi * channel.carrier_hz / LIGHT_M_S
    if channel.model == "log_distance":
        return np.asarray(20 * np.log10(waves * NEAR_M) + 10 * channel.exponent * np.log10(far / NEAR_M))
    loss = 20 * np.log10(waves * far)
    if channel.model == "two_ray":
        reflected = np.hypot(far, 2 * channel.height_m)
        turn = (reflected - far) * waves / 2
        field = np.abs(1 - far / reflected * np.exp(-1j * turn))
        loss = loss - 20 * np.log10(np.maximum(field, 1e-6))
    return np.asarray(loss)


def doppler_hz(ways: Floats, velocities: Floats, carrier_hz: float) -> Floats:
    """Shift of the carrier at receivers, Hz: above 0 where the ends approach each other.

    :param ways: from the sender to each receiver, m, shape (n, 2)
    :param velocities: of each receiver as seen from the sender, m/s, shape (n, 2)
    """
    apart = np.maximum(np.hypot(*ways.T), 1e-9)
    return np.asarray(-(ways * velocities).sum(1) / apart * (carrier_hz / LIGHT_M_S))


class Shadowing:
    """Shadowing with the correlation of Gudmundson (1991) for each end: e^-(way / decorrelation).

    One field over the places of both ends, as a sum of sinusoids (Wang, Tameh and Nix, 2008): its correlation is the
    product of those for the ways of both ends. Both directions of a pair agree.

    :param sigma_db: standard deviation, dB
    :param decorrelation_m: way of one end after which 1/e of the correlation is left
    """

    def __init__(self, sigma_db: float, decorrelation_m: float, seed: int) -> None:
        self.sigma_db, self.decorrelation_m = sigma_db, decorrelation_m
        draw = np.random.default_rng([seed, 4])
        turns = draw.uniform(0, 2 * np.pi, (2, _WAVES))
        # The spectrum of e^-r in the plane is (1 + k^2)^-3/2: the share of waves below k is 1 - (1 + k^2)^-1/2.
        pulses = np.sqrt((1 - draw.uniform(0, 1, (2, _WAVES))) ** -2 - 1) / decorrelation_m
        self._waves = np.stack([pulses * np.cos(turns), pulses * np.sin(turns)], 1)
        self._phases = draw.uniform(0, 2 * np.pi, _WAVES)

    def ends(self, places: Floats) -> tuple[Any, Any]:
        """What the field has of places, shape (n, 2), as one end and as the other; for :meth:`between`."""
        one = (places @ self._waves[0] + self._phases).astype(np.float32)
        other = (places @ self._waves[1]).astype(np.float32)
        return np.hstack([np.cos(one), -np.sin(one)]), np.hstack([np.cos(other), np.sin(other)])

    def between(self, here: tuple[Any, Any], there: tuple[Any, Any], apart: Floats) -> Floats:
        """Shadowing in dB from one place to others, or the other way round.

        :param here: :meth:`ends` of one place, each of shape (2 waves,)
        :param there: of the others, each of shape (n, 2 waves)
        :param apart: distances in m, shape (n,)
        """
        # Not a product of matrices: NumPy would use threads for it, which costs more than it saves.
        field = np.einsum("ij,j->i", there[1], here[0]) + np.einsum("ij,j->i", there[0], here[1])
        # The sum of both directions has a variance that grows where they are correlated: near each other.
        both = np.sqrt(_WAVES * (1 + np.exp(-2 * apart / self.decorrelation_m)))
        return np.asarray(self.sigma_db * field / both)
