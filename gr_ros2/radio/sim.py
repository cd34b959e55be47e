"""The `sim` front end: no radio. What a robot sends comes back through the channel model, as another robot receives it.

Use it to try a configuration on one machine: publish on the robot's topics, and see them in the sink's namespace.
"""

from __future__ import annotations

from typing import Any

from gnuradio import blocks, gr

from gr_ros2.phy import Phy
from gr_ros2.radio.front_end import FrontEnd


class SimFrontEnd(FrontEnd):
    """The transmitter's samples as what is received. The channel model between them belongs to the link."""

    name = "sim"
    loops_back = True
    hears_always = False
    timing_error_s = 0.005
    any_length = True

    def __init__(self, phy: Phy, **options: Any) -> None:
        super().__init__(phy, **options)
        self._through = blocks.copy(gr.sizeof_gr_complex)

    @property
    def sink(self) -> Any:
        return self._through

    @property
    def source(self) -> Any:
        return self._through
