"""The curves physical layers are measured against: error rates of ideal receivers in white noise.

Laws: SNR arguments are ratios, not dB; perfect synchronisation is assumed everywhere, so a measured curve lies right
of these by what synchronisation, pilots and framing cost. Source: Proakis and Salehi, Digital Communications, 5th
edition, sections 4.3 (PSK, QAM) and 4.5 (noncoherent orthogonal signals).
"""

from __future__ import annotations

from math import erfc, exp, lgamma, log1p, pi, sin, sqrt

import numpy as np


def q(x: float) -> float:
    """Tail of the normal distribution."""
    return 0.5 * erfc(x / sqrt(2))


def psk_symbol_error(order: int, snr: float) -> float:
    """PSK, coherent. Exact for 2 and 4 phases, from 8 on to within a hundredth of itself below 0.1.

    :param order: phases
    :param snr: Es/N0
    """
    if order == 2:
        return q(sqrt(2 * snr))
    if order == 4:
        half = q(sqrt(snr))
        return 2 * half - half**2
    return min(1.0, 2 * q(sqrt(2 * snr) * sin(pi / order)))


def qam_symbol_error(order: int, snr: float) -> float:
    """Square QAM, coherent, exact.

    :param order: points: 4, 16, 64 …
    :param snr: Es/N0
    """
    side = 2 * (1 - 1 / sqrt(order)) * q(sqrt(3 * snr / (order - 1)))
    return 1 - (1 - side) ** 2


def orthogonal_symbol_error(count: int, snr: float) -> float:
    """Orthogonal signals, the strongest wins, phase unknown (chirps are).

    :param count: signals
    :param snr: Es/N0
    """
    # The winner's squared amplitude is Rice distributed: integrate over it that all others stay below.
    r = np.linspace(0.0, sqrt(2 * snr) + 12.0, 4000)
    a = sqrt(2 * snr)
    log_bessel = np.log(np.i0(np.minimum(a * r, 600.0)))
    large = a * r > 600
    log_bessel[large] = (a * r - 0.5 * np.log(2 * pi * np.maximum(a * r, 1.0)))[large]
    density = r * np.exp(-(r**2 + a**2) / 2 + log_bessel)
    below = -np.expm1(-(r**2) / 2)
    wrong = density * (1 - below ** (count - 1))
    return float(min(1.0, ((wrong[1:] + wrong[:-1]) / 2 * np.diff(r)).sum()))


def packet_success(error: float, count: int) -> float:
    """Probability that none of ``count`` independent symbols is wrong."""
    return exp(count * log1p(-error)) if error < 1 else 0.0


def at_least(least: int, count: int, probability: float) -> float:
    """Probability that at least ``least`` of ``count`` independent events happen."""
    if probability <= 0:
        return 0.0
    if probability >= 1:
        return 1.0
    terms = (
        exp(lgamma(count + 1) - lgamma(k + 1) - lgamma(count - k + 1) + k * np.log(probability)
            + (count - k) * log1p(-probability))
        for k in range(least, count + 1)
    )  # fmt: skip
    return min(1.0, sum(terms))


def half_point(success: object) -> float:
    """dB at which a function of dB that rises from 0 to 1 passes one half, between -60 and 80."""
    assert callable(success)
    low, high = -60.0, 80.0
    while high - low > 1e-3:
        middle = (low + high) / 2
        low, high = (middle, high) if success(middle) < 0.5 else (low, middle)
    return (low + high) / 2


__all__ = [
    "at_least",
    "half_point",
    "orthogonal_symbol_error",
    "packet_success",
    "psk_symbol_error",
    "q",
    "qam_symbol_error",
]
