"""What tests of whole links share: packets through a PHY at the pace of the air, and back into another block."""

from __future__ import annotations

import weakref
from typing import Any

from gr_ros2.phy import Phy
from gr_ros2.phy.flowgraph import Flowgraph
from gr_ros2.radio.radio import Radio
from gr_ros2.radio.sim import SimFrontEnd


class Loopback(Flowgraph):
    """From a source's message port `pdus` over a radio that hears itself to that of a sink; ``options`` are those of
    :class:`Radio`."""

    def __init__(self, phy: Phy, source: Any, sink: Any, **options: Any) -> None:
        super().__init__("gr_ros2_loopback", f"phy {phy.name}")
        self.radio = Radio(phy, SimFrontEnd(phy), **options)
        self.msg_connect(source, "pdus", self.radio, "pdus")
        self.msg_connect(self.radio, "credit", source, "credit")
        self.msg_connect(self.radio, "pdus", sink, "pdus")
        weakref.finalize(self, self.radio.close)  # frees shared memory, of which a system has 4096 segments
