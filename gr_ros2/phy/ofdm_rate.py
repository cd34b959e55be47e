"""The MCS table of the `ofdm` PHY: the modulations and codes from which an adaptive rate chooses.

Invariant: each MCS is a PHY with a fixed rate, and differs from the others in payload modulation and code only.
"""

from __future__ import annotations

from gr_ros2.link.rate import Mcs
from gr_ros2.phy.base import Phy
from gr_ros2.phy.theory import half_point

RATES: dict[str, tuple[str, str, float]] = {
    "bpsk-cc": ("bpsk", "cc", 2.4),
    "qpsk-cc": ("qpsk", "cc", 2.4),
    "8psk-cc": ("8psk", "cc", 3.1),
    "16qam-cc": ("16qam", "cc", 3.0),
    "64qam-cc": ("64qam", "cc", 3.4),
    "16qam": ("16qam", "none", 0.1),
    "64qam": ("64qam", "none", 0.3),
}
"""Payload modulation and code of each MCS, the most robust one first; and how many dB more it needs for half of its
packets than ``computed_pdr`` says, as measured for packets of 220 B. For the code that is a bound."""
_WIDTH_DB = {"cc": 0.4, "none": 0.5}


def mcs_of(name: str, phy: Phy) -> Mcs:
    """What the choice of a rate has to know about an MCS.

    :param phy: the PHY of this MCS
    """
    _, fec, loss_db = RATES[name]
    return Mcs(name, phy.airtime(), half_point(phy.computed_pdr) + loss_db, _WIDTH_DB[fec])
