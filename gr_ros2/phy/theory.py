"""Reference curves of physical layers: error rates of ideal receivers in white noise.

Invariants: SNR arguments are ratios, not dB; perfect synchronisation is assumed, so a measured curve is shifted by the
cost of synchronisation, pilots and framing. Source: Proakis and Salehi, Digital Communications, 5th edition, sections
4.3 (PSK, QAM) and 4.5 (noncoherent orthogonal signals).
"""

from __future__ import annotations

from fractions import Fraction
from functools import lru_cache
from math import erfc, exp, lgamma, log, log1p, log2, log10, pi, sin, sqrt

import numpy as np
from numpy.typing import NDArray


def q(x: float) -> float:
    """Tail of the normal distribution."""
    return 0.5 * erfc(x / sqrt(2))


def psk_symbol_error(order: int, snr: float) -> float:
    """PSK, coherent. Exact for 2 and 4 phases; for 8 and more the relative error is below 1 % where the result is below
    0.1.

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


def qam_bit_error(bits: int, snr: float) -> float:
    """BPSK and Gray-coded square QAM, coherent, each bit decided by itself: mean over the bits, exact.

    :param bits: of a point: 1, 2, 4 or 6
    :param snr: Es/N0
    """
    x = sqrt(snr * {1: 2, 2: 1, 4: 1 / 5, 6: 1 / 21}[bits])
    if bits <= 2:
        return q(x)
    if bits == 4:
        return (3 * q(x) + 2 * q(3 * x) - q(5 * x)) / 4
    return (7 * q(x) + 6 * q(3 * x) - q(5 * x) + q(9 * x) - q(13 * x)) / 12


_EVENTS = {
    (1, 2): (10, (11, 0, 38, 0, 193, 0, 1331, 0, 7275)),
    (2, 3): (6, (1, 16, 48, 158, 642, 2435, 9174)),
    (3, 4): (5, (8, 31, 160, 892, 4512, 23307)),
}
"""By code rate: free distance of the code 133/171 (octal) punctured as in IEEE 802.11, and its numbers of error events
at this and the next distances (Haccoun and Begin, IEEE Trans. Commun. 37-11, 1989)."""


def convolutional_success(rate: tuple[int, int], error: float, data_bits: int) -> float:
    """Probability that a Viterbi decoder with hard decisions finds all bits of IEEE 802.11's convolutional code.

    The union bound of error events (Pursley and Taipale, IEEE Trans. Commun. 35-11, 1987), so it is pessimistic.

    :param rate: 1/2, 2/3 or 3/4, as a fraction that need not be reduced
    :param error: probability that a coded bit is wrong, below 1/2
    """
    share = Fraction(*rate)
    free, events = _EVENTS[share.numerator, share.denominator]
    begins = sum(count * _confused(free + more, error) for more, count in enumerate(events) if count)
    return packet_success(begins, data_bits)


def _confused(distance: int, error: float) -> float:
    """Probability that a path with ``distance`` other bits fits better, half of it where both fit as well."""
    if distance % 2:
        return at_least((distance + 1) // 2, distance, error)
    tie = distance // 2
    return (at_least(tie, distance, error) + at_least(tie + 1, distance, error)) / 2


def orthogonal_symbol_error(count: int, snr: float) -> float:
    """Orthogonal signals with unknown phase, such as chirps; the strongest is decided.

    :param count: signals
    :param snr: Es/N0
    """
    # The amplitude of the right signal is Rice distributed: integrate the probability that all others are below it.
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


def coded_success(points: NDArray[np.complex64], snr: float, data_bits: int, coded_bits: int) -> float:
    """Probability that the best possible code of this length and rate delivers.

    The normal approximation of Polyanskiy, Poor and Verdu (IEEE Trans. Inf. Theory 56-5, 2010): the information of a
    frame's points is approximately normal, and must exceed the data.

    :param points: constellation points, equally likely
    :param snr: mean energy of a point over N0
    :param coded_bits: number of bits sent; each point carries log2 of the number of points
    """
    moments = _information(points.tobytes(), round(10 * log10(max(snr, 1e-6)), 2))
    return _enough(coded_bits / log2(len(points)), *moments, data_bits)


def coded_orthogonal_success(order: int, error: float, data_bits: int, count: int) -> float:
    """The same as :func:`coded_success` for ``count`` orthogonal signals, each decided independently.

    :param order: signals to choose from
    :param error: probability that a decision is wrong
    """
    error = min(max(error, 1e-12), 1 - 1 / order)
    wrong = log2(error / (order - 1))
    right = log2(1 - error)
    mean = log2(order) + (1 - error) * right + error * wrong
    return _enough(count, mean, error * (1 - error) * (right - wrong) ** 2, data_bits)


def _enough(count: float, mean: float, variance: float, data_bits: int) -> float:
    """Probability that ``count`` symbols carry more information than the data bits; mean and variance are those of one
    symbol."""
    spread = sqrt(max(count * variance, 1e-12))
    return 1 - q((count * mean - data_bits + 0.5 * log2(count)) / spread)


@lru_cache(maxsize=4096)
def _information(points: bytes, snr_db: float) -> tuple[float, float]:
    """Mean and variance of the information of one received point, bits."""
    sent = np.frombuffer(points, np.complex64).astype(np.complex128)
    noise = np.mean(np.abs(sent) ** 2) / 10 ** (snr_db / 10)
    nodes, weights = np.polynomial.hermite.hermgauss(24)
    added = sqrt(noise) * (nodes[:, None] + 1j * nodes).reshape(-1)
    share = (weights[:, None] * weights).reshape(-1) / pi
    apart = np.abs(sent[:, None, None] - sent[None, :, None] + added) ** 2
    information = log2(len(sent)) - np.logaddexp.reduce((np.abs(added) ** 2 - apart) / noise, axis=1) / log(2)
    mean = float(np.mean(information @ share))
    return mean, float(np.mean(information**2 @ share)) - mean**2


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
    "coded_orthogonal_success",
    "coded_success",
    "convolutional_success",
    "half_point",
    "orthogonal_symbol_error",
    "packet_success",
    "psk_symbol_error",
    "q",
    "qam_bit_error",
    "qam_symbol_error",
]
