"""The parts of frames that zstd packs, with the bounds of ``compression.bounds``.

Invariants: what comes out is bounded by the number of packed bytes, so that a short frame costs its receiver little;
arbitrary bytes raise only DamagedError.
"""

from __future__ import annotations

from gr_ros2.compression import bounds
from gr_ros2.compression.zstd_frames import Zstd

_LEVEL = 9


class Packer:
    """:param level: of zstd, for sending only"""

    def __init__(self, level: int = _LEVEL) -> None:
        self._zstd = Zstd(level=level)

    def pack(self, data: bytes) -> bytes:
        """The packed form."""
        return self._zstd.compress(data, least=bounds.least(len(data)))

    def unpack(self, data: bytes, max_size: int) -> bytes:
        """The original bytes.

        :raises DamagedError: not a packed form, or more than ``max_size`` bytes
        """
        return self._zstd.decompress(data, min(max_size, bounds.largest(len(data))))
