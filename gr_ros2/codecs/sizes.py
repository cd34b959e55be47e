"""The size of a picture that is sent: both sides halved as often as its budget, its options and its receivers need.

A smaller picture is better than a coarser one where the budget is below ``LEAST_PER_BLOCK`` bytes for each 16 × 16
pixels. Invariant: equal pictures and budgets give equal sizes.
"""

from __future__ import annotations

from gr_ros2.codecs.base import MAX_SIZE

BLOCK = 16
"""Pixels of the side of a block, the unit that H.264 codes."""
MAX_PIXELS = 1 << 23
"""Of a picture: 3840 × 2160 and a little more."""
_MAX_SIDE = 1 << 14
"""Pixels of a side that x264 takes."""
LEAST_PER_BLOCK = 3
"""Bytes."""
AUTO, FULL = "auto", "full"
_SLOWLY, _CLEARLY = 8, 1.5
"""The size follows the mean of about so many budgets, once it would be wrong by this factor."""
_OUTER = 1024
"""Bytes of an image beside its pixels, at most, but for the longest names of frames."""
_SMALLEST = 64
"""Pixels of the shorter side, below which no image is halved."""


class FittingSize:
    """The size of the pictures of one topic.

    :param most: 'auto', 'full', or the most pixels as '320x240'
    """

    def __init__(self, most: str = AUTO) -> None:
        self._most = most
        self._mean = 0.0
        self._halved: int | None = None
        self._of = (0, 0)

    def halvings(self, width: int, height: int, bytes_each: int, budget: int, key: bool) -> int:
        """How often each side is halved.

        :param bytes_each: of a pixel where it comes out; 0 where the picture comes out packed
        :param budget: bytes
        :param key: whether a key frame is to be sent, so that another size costs nothing
        """
        sizes = [0]
        while not _makes(*halved(width, height, sizes[0]), bytes_each):
            sizes[0] += 1
        while min(halved(width, height, sizes[-1] + 1)) >= _SMALLEST:
            sizes.append(sizes[-1] + 1)
        if self._most == FULL:
            return sizes[0]
        if self._most != AUTO:
            most = tuple(map(int, self._most.split("x")))
            fitting = [n for n in sizes if all(a <= b for a, b in zip(halved(width, height, n), most, strict=True))]
            return fitting[0] if fitting else sizes[-1]
        if self._halved is None or self._of != (width, height):
            self._halved, self._of, self._mean, key = None, (width, height), budget, True
        else:
            self._mean += (budget - self._mean) / _SLOWLY

        def needs(times: int) -> int:
            return LEAST_PER_BLOCK * blocks(*halved(width, height, times))

        wanted = next((n for n in sizes if needs(n) <= self._mean), sizes[-1])
        if (
            self._halved is None
            or key
            or (wanted > self._halved and needs(self._halved) > _CLEARLY * self._mean)
            or (wanted < self._halved and needs(wanted) * _CLEARLY < self._mean)
        ):
            self._halved = wanted
        return self._halved


def _makes(width: int, height: int, bytes_each: int) -> bool:
    """Whether the encoder takes, and a receiver makes, a picture of this size."""
    fits = max(width, height) <= _MAX_SIDE and width * height <= MAX_PIXELS
    return fits and width * height * bytes_each + _OUTER <= MAX_SIZE


def blocks(width: int, height: int) -> int:
    """Blocks of a picture."""
    return -(-width // BLOCK) * -(-height // BLOCK)


def halved(width: int, height: int, times: int) -> tuple[int, int]:
    """The size of a picture whose sides are halved so often."""
    return -(-width // (1 << times)), -(-height // (1 << times))
