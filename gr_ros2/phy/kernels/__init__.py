"""Compiled kernels of the burst modems: search and reading in C++17, an optional part of the package.

Invariants: numpy is the reference and the fallback, and finds the same packets; which one runs can be told in one line;
the C++ has no dependencies, starts no threads and knows neither Python nor GNU Radio.
"""

from __future__ import annotations

from gr_ros2.config import Kernels
from gr_ros2.phy.burst import BurstModem
from gr_ros2.phy.kernels.library import loaded
from gr_ros2.phy.kernels.modem import CompiledModem


def fastest(modem: BurstModem, kernels: Kernels) -> BurstModem:
    """The modem as it is to run: with its compiled kernel where that is wanted and there is one, else itself."""
    wanted = kernels == "auto" and loaded().functions is not None and modem.constants() is not None
    return CompiledModem(modem) if wanted else modem


def which(kernels: Kernels) -> str:
    """What runs, and why, in one line."""
    if kernels == "numpy":
        return "numpy, as set"
    found = loaded()
    return f"compiled, {found.about}" if found.functions is not None else f"numpy, for want of kernels: {found.about}"
