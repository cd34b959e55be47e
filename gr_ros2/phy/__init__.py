"""Physical layers behind one interface: choose one by name."""

from __future__ import annotations

from gr_ros2.backends import Backend, BackendTable
from gr_ros2.phy.base import Phy

PHY = BackendTable(
    "phy",
    {
        "direct": Backend("gr_ros2.phy.direct", "DirectPhy", "message loopback, no samples"),
        "ofdm": Backend(
            "gr_ros2.phy.ofdm", "OfdmPhy", "GNU Radio's stock OFDM", "GNU Radio 3.10 (apt install gnuradio)"
        ),
    },
)

__all__ = ["PHY", "Phy"]
