"""A burst modem that uses a compiled kernel for search and demodulation.

Invariants: the numpy modem, which is the reference, does everything except the processing of samples; a kernel knows
only the constants of that modem; calls from several threads do not share memory.
"""

from __future__ import annotations

import ctypes
import weakref
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gr_ros2.phy.burst import BurstModem, ModemConstants, Reading, Samples, Search
from gr_ros2.phy.kernels.library import loaded

_NONE = -(2**63)
_NO_MEMORY = 2**63 - 1

Fields = Mapping[str, str]
"""Names of a kernel's numbers and arrays, in the order of its struct in ``modem.h``, by type."""


def _fields(**names: str) -> Fields:
    return {name: kind for kind, listed in names.items() for name in listed.split()}


KERNELS: dict[str, tuple[int, Fields]] = {
    "ofdm": (
        0,
        _fields(
            int32="shortest longest rung_count counted size prefix repeat degrees chunk carrier_count data_count "
            "pilot_count once_count twice_count shift_count",
            float64="level alike energy power pair_weight word_weight_sum pace_gain memory reach doubt",
            int32s="frame_bits point_counts point_bits carriers data pilots once twice shifts",
            complex64s="words known turns whole smooth smooth_words crosswise points",
            float32s="word_weight",
            uint8s="marks headers header_mask",
        ),
    ),
    "linear": (
        1,
        _fields(
            int32="shortest longest sps order point_bits preamble chunk block rise edge slack unknowns differential "
            "last_one",
            float64="turn clean_energy threshold alike",
            int32s="frame_bits",
            float32s="signs steps",
            complex64s="known explained points",
            uint8s="marks",
        ),
    ),
    "lora": (
        2,
        _fields(
            int32="shortest longest before chips spreading_factor code_bits step look head sync down fine sinc",
            float64="median_share limit threshold gain pace_gain certain",
            int32s="frame_bits telling words",
            complex64s="down_chirp up_chirp tapered",
        ),
    ),
}
"""Number of each kernel, and the names of its parameters."""
_NUMBERS = {"int32": ctypes.c_int32, "float64": ctypes.c_double}


class _Report(ctypes.Structure):
    """The struct of the same name in ``modem.h``."""

    _fields_ = (
        ("snr", ctypes.c_double),
        ("end", ctypes.c_int64),
        ("length", ctypes.c_int64),
        ("soft", ctypes.c_int64),
        ("points", ctypes.c_int64),
        ("rung", ctypes.c_int64),
    )


_NO_BURST, _READ, _CUT = range(3)
"""``Result`` of ``modem.h``."""


class CompiledModem(BurstModem):
    """The given modem, with search and demodulation by the compiled kernel.

    :param reference: the numpy modem; its constants name the kernel
    :raises MemoryError: when memory is short
    """

    def __init__(self, reference: BurstModem) -> None:
        super().__init__(reference.frames)
        constants = reference.constants()
        assert constants is not None
        self._reference = reference
        self.margin, self.stretch = reference.margin, reference.stretch
        self._functions = loaded().functions
        self._kernel = _new(self._functions, constants)
        weakref.finalize(self, self._functions.modem_free, self._kernel)
        self._soft, self._points = constants.soft_bits, constants.points
        given = reference.rungs
        self._rungs = tuple(CompiledModem(modem) for modem in given) if len(given) > 1 else ()

    def __reduce__(self) -> Any:
        return CompiledModem, (self._reference,)  # memory of a library stays in its process

    @property
    def rungs(self) -> Sequence[BurstModem]:
        return self._rungs or (self,)

    def samples_of(self, packet_len: int) -> int:
        return self._reference.samples_of(packet_len)

    @property
    def span(self) -> int:
        return self._reference.span

    @property
    def preamble_samples(self) -> int:
        return self._reference.preamble_samples

    @property
    def peak_samples(self) -> int:
        return self._reference.peak_samples

    def modulate(self, packet: bytes) -> Samples:
        bits = self.frames.of(len(packet)).wrap(packet)
        out = np.empty(self.samples_of(len(packet)), np.complex64)
        if _checked(self._functions.modem_modulate(self._kernel, _address(bits), len(packet), _address(out))):
            return out
        return self._reference.modulate(packet)

    def find(self, samples: Samples) -> Search:
        samples = np.ascontiguousarray(samples, np.complex64)
        start = ctypes.c_int64()
        found = self._functions.modem_find(self._kernel, _address(samples), len(samples), ctypes.addressof(start))
        return Search(_counted(found), None if start.value == _NONE else start.value)

    def read(self, samples: Samples, start: int) -> Reading | None:
        samples = np.ascontiguousarray(samples, np.complex64)
        soft, points = np.empty(self._soft, np.float32), np.empty(self._points, np.complex64)
        report = _Report()
        given = (_address(samples), len(samples), start, _address(soft), _address(points), ctypes.addressof(report))
        result = _checked(self._functions.modem_read(self._kernel, *given))
        if result == _NO_BURST:
            return None
        if result == _CUT:
            return Reading(report.length, None, points[:0], report.snr, report.end, report.rung)
        read = (soft[: report.soft], points[: report.points])
        return Reading(report.length, *read, report.snr, report.end, report.rung)


def _new(functions: Any, constants: ModemConstants) -> int:
    """A kernel in the library's memory."""
    number, fields = KERNELS[constants.kernel]
    arrays = []
    values: list[Any] = []
    for name, kind in fields.items():
        value = constants.values[name]
        if kind in _NUMBERS:
            values.append(value)
        else:
            arrays.append(np.ascontiguousarray(value, kind.removesuffix("s")))
            values.append(_address(arrays[-1]))
    types = [(name, _NUMBERS.get(kind, ctypes.c_void_p)) for name, kind in fields.items()]
    struct = type("Parameters", (ctypes.Structure,), {"_fields_": types})(*values)
    kernel: int | None = functions.modem_new(number, ctypes.addressof(struct), ctypes.sizeof(struct))
    if kernel is None:
        raise MemoryError(f"no memory for the compiled kernel of {constants.kernel}, or it is of another version")
    return kernel


def _address(array: NDArray[Any]) -> int:
    address: int = array.__array_interface__["data"][0]  # three times as fast as array.ctypes
    return address


def _counted(result: int) -> int:
    if result == _NO_MEMORY:
        raise MemoryError("no memory for a compiled kernel to work in")
    return result


def _checked(result: int) -> int:
    if result < 0:
        raise MemoryError("no memory for a compiled kernel to work in")
    return result
