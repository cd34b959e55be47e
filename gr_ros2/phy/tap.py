"""Taps: copies of passing samples, for the display of constellation and spectrum.

Invariants: a tap only reads; it exists only in an instrumented flowgraph, and costs nothing elsewhere; it keeps only
the newest ``size`` samples.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
from gnuradio import gr

Samples = npt.NDArray[np.complex64]

SYMBOLS_SHOWN = 480
"""Symbols of a constellation that are shown at a time."""


class Tap(gr.hier_block2):  # type: ignore[misc]
    """Complex stream in; gives the newest complete block of it on request.

    :param size: samples per block, at least 1
    """

    def __init__(self, size: int) -> None:
        from gnuradio import blocks  # here: 7 MB that a link whose bursts come as a whole does not need

        super().__init__("gr_ros2_tap", gr.io_signature(1, 1, gr.sizeof_gr_complex), gr.io_signature(0, 0, 0))
        self._probe = blocks.probe_signal_vc(size)
        self.connect(self, blocks.stream_to_vector(gr.sizeof_gr_complex, size), self._probe)

    def samples(self) -> Samples | None:
        """``size`` consecutive samples, None before that many have passed."""
        newest: Any = np.array(self._probe.level(), dtype=np.complex64)
        return newest if newest.any() else None


class BurstTap:
    """The newest samples of bursts that come as a whole.

    :param size: samples
    """

    def __init__(self, size: int) -> None:
        self._size = size
        self._bursts: tuple[Samples, ...] = ()
        """The newest, no more than hold so many samples."""

    def add(self, samples: Samples) -> None:
        """A burst, or a part of one, which nobody changes any more."""
        bursts = (*self._bursts, samples)
        more = sum(map(len, bursts)) - self._size
        while more >= len(bursts[0]):
            more -= len(bursts[0])
            bursts = bursts[1:]
        self._bursts = bursts

    def samples(self) -> Samples | None:
        """``size`` consecutive samples, None before that many have come."""
        newest = np.concatenate(self._bursts or [np.empty(0, np.complex64)])[-self._size :]
        return newest if len(newest) == self._size else None


class SymbolTap:
    """The newest symbols of a receiver that decodes whole packets.

    :param newest: gives the symbols of the last packet, none before the first
    """

    def __init__(self, newest: Callable[[], Samples]) -> None:
        self._newest = newest

    def samples(self) -> Samples | None:
        """Up to ``SYMBOLS_SHOWN`` symbols, None before the first packet."""
        return self._newest()[-SYMBOLS_SHOWN:] if len(self._newest()) else None
