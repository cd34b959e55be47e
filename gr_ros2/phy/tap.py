"""A look at samples that pass by, for people: constellation and spectrum.

Invariants: a tap only reads; it exists only in a flowgraph that was built to be looked at, and costs nothing elsewhere;
it keeps the newest ``size`` samples and nothing else.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
from gnuradio import blocks, gr

Samples = npt.NDArray[np.complex64]

SYMBOLS_SHOWN = 480
"""Of a constellation, at a look."""


class Tap(gr.hier_block2):  # type: ignore[misc]
    """Complex stream in; the newest whole block of it on demand.

    :param size: samples per look, at least 1
    """

    def __init__(self, size: int) -> None:
        super().__init__("gr_ros2_tap", gr.io_signature(1, 1, gr.sizeof_gr_complex), gr.io_signature(0, 0, 0))
        self._probe = blocks.probe_signal_vc(size)
        self.connect(self, blocks.stream_to_vector(gr.sizeof_gr_complex, size), self._probe)

    def samples(self) -> Samples | None:
        """``size`` consecutive samples, None before that many have passed."""
        newest: Any = np.array(self._probe.level(), dtype=np.complex64)
        return newest if newest.any() else None


class SymbolTap:
    """The newest symbols of a receiver that decides whole packets.

    :param newest: gives the symbols of the last packet, none before the first
    """

    def __init__(self, newest: Callable[[], Samples]) -> None:
        self._newest = newest

    def samples(self) -> Samples | None:
        """Up to ``SYMBOLS_SHOWN`` symbols, None before the first packet."""
        return self._newest()[-SYMBOLS_SHOWN:] if len(self._newest()) else None
