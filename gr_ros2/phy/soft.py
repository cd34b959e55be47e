"""Constellations, and the soft bits of received points.

Invariants: a soft bit is a log-likelihood ratio, above 0 for a 1, computed from the nearest point of either value
("max-log"); its sign is the decision for the nearest point.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from gr_ros2.phy.fec import Bits, Soft

Complex = NDArray[np.complex64]
Reals = NDArray[np.float64]
BitOrder = Literal["big", "little"]
_TINY = 1e-20
_SMALLEST_NOISE = 1e-6
"""Least noise, relative to a point's energy, so that soft bits stay finite without noise."""


class Points:
    """A constellation.

    :param points: by value, a power of 2 of them
    :param order: whether the first bit sent is the highest or the lowest of a value
    """

    def __init__(self, points: NDArray[np.complex128], order: BitOrder) -> None:
        self.points = points.astype(np.complex64)
        self._twice = 2 * np.stack((self.points.real, self.points.imag))
        self._squares = np.abs(self.points) ** 2
        self.power = float(self._squares.mean())
        self.bits = len(points).bit_length() - 1
        places = np.arange(self.bits) if order == "little" else np.arange(self.bits)[::-1]
        self._weights = 1 << places
        self.marks = marks = (np.arange(len(points))[:, None] >> places) & 1 == 1
        """Array of points by bits: whether the bit is 1."""
        self._ones = [np.flatnonzero(mark) for mark in marks.T]
        self._zeros = [np.flatnonzero(~mark) for mark in marks.T]

    def map(self, bits: Bits) -> Complex:
        """Bits, filled up with zeros, to points."""
        count = -(-len(bits) // self.bits)
        padded = np.zeros(count * self.bits, np.int64)
        padded[: len(bits)] = bits
        return np.asarray(self.points[padded.reshape(count, self.bits) @ self._weights])

    def weigh(self, received: Complex, noise: Reals | float) -> NDArray[np.float32]:
        """Log-likelihood of every point (columns) for every received point (rows), except for a constant of each row.

        :param noise: mean squared magnitude of the noise, one value or one for each received point
        """
        scale = np.asarray(1 / np.maximum(noise, _SMALLEST_NOISE * self.power), np.float32).reshape(-1, 1)
        # The squared distance without the squared magnitude of the received point, which is the same for all points.
        parts = np.ascontiguousarray(received, np.complex64).view(np.float32).reshape(-1, 2)
        return np.asarray((parts @ self._twice - self._squares) * scale)

    def soft(self, likely: NDArray[np.float32]) -> Soft:
        """Soft bits of received points, in the order in which the bits are sent."""
        bits = [likely[:, ones].max(1) - likely[:, zeros].max(1)
                for ones, zeros in zip(self._ones, self._zeros, strict=True)]  # fmt: skip
        return np.asarray(np.stack(bits, axis=1).reshape(-1), np.float32)

    def expected(self, likely: NDArray[np.float32]) -> tuple[Complex, NDArray[np.float32]]:
        """Conditional mean of the point sent, given the received point, and of its squared magnitude."""
        share = np.exp(likely - likely.max(1, keepdims=True))
        share /= share.sum(1, keepdims=True)
        return share @ self.points, share @ self._squares

    def nearest(self, received: Complex) -> Complex:
        """The nearest constellation point of each received point."""
        return np.asarray(self.points[np.argmax(self.weigh(received, 1.0), axis=1)])


def spread_about(received: Complex, decided: Complex) -> tuple[float, float]:
    """Gain and noise of received points: the factor of the decided points, and the mean square of the rest."""
    energy = float(np.vdot(decided, decided).real)
    gain = max(float(np.vdot(decided, received).real) / max(energy, _TINY), _TINY)
    return gain, float(np.mean(np.abs(received - gain * decided) ** 2))
