"""Compiled kernels of the burst modems and decoders of codes in C++17, an optional part of the package.

Invariants: numpy is the reference and the fallback, and finds the same packets; one line says which of the two runs;
the C++ code has no dependencies, starts no threads and uses neither Python nor GNU Radio.
"""

from __future__ import annotations

from gr_ros2.phy.burst import BurstModem
from gr_ros2.phy.fec import GNU_RADIO, Decoders
from gr_ros2.phy.kernels.codes import CompiledDecoders
from gr_ros2.phy.kernels.library import loaded
from gr_ros2.phy.kernels.modem import CompiledModem
from gr_ros2.settings.config import Kernels


def fastest(modem: BurstModem, kernels: Kernels) -> BurstModem:
    """The modem with its compiled kernel where one exists and the setting allows it, otherwise the modem itself."""
    wanted = kernels == "auto" and loaded().functions is not None and modem.constants() is not None
    return CompiledModem(modem) if wanted else modem


def decoders(kernels: Kernels) -> Decoders:
    """Compiled decoders where they exist and the setting allows them, otherwise GNU Radio's."""
    return CompiledDecoders() if kernels == "auto" and loaded().functions is not None else GNU_RADIO


def which(kernels: Kernels) -> str:
    """What runs, and why, in one line."""
    if kernels == "numpy":
        return "numpy, as set"
    found = loaded()
    return f"compiled, {found.about}" if found.functions is not None else f"numpy, no compiled kernels: {found.about}"
