"""A burst modem that uses a compiled kernel for modulation, search and demodulation.

Invariants: the numpy modem, which is the reference, does everything except the processing of samples; a kernel knows
only the constants of that modem; calls from several threads do not share memory. Each call releases Python's lock, so a
link processes several packets per call: waiting for the lock afterwards takes longer than a short burst.
"""

from __future__ import annotations

import ctypes
import weakref
from array import array
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any

import numpy as np

from gr_ros2.phy.burst import (
    BurstModem,
    BurstReceiver,
    DemodulatedPacket,
    Frames,
    ModemConstants,
    Reading,
    Samples,
    Search,
)
from gr_ros2.phy.kernels.library import address, checked, loaded

_NONE = -(2**63)
_NO_MEMORY = 2**63 - 1
_NEEDS_SAMPLES, _FULL, _NOT_PLAIN = range(3)
"""Why a call of :meth:`CompiledModem.take` ended: ``Taken`` in ``stream.h``."""
_ROOM = 32
"""Packets that one call may find."""

Fields = Mapping[str, str]
"""Names of a kernel's numbers and arrays, in the order of its struct in ``modem.h``, by type."""


def _fields(**names: str) -> Fields:
    return {name: kind for kind, listed in names.items() for name in listed.split()}


KERNELS: dict[str, tuple[int, Fields]] = {
    "ofdm": (
        0,
        _fields(
            int32="shortest longest mcs_count counted size prefix repeat degrees chunk carrier_count data_count "
            "pilot_count once_count twice_count shift_count even_count delay_count weight_count fractions",
            float64="level alike together energy power pair_weight word_weight_sum clocks unsteady memory reach doubt "
            "sure delay_step",
            int32s="frame_bits point_counts point_bits carriers data pilots once twice shifts",
            complex64s="words known turns whole smooth smooth_words crosswise points advances",
            float32s="word_weight delays weights",
            uint8s="marks headers header_mask",
        ),
    ),
    "linear": (
        1,
        _fields(
            int32="shortest longest sps order point_bits preamble chunk block rise edge slack unknowns differential "
            "last_one pulse_len lead_len tail_len",
            float64="turn clean_energy threshold alike",
            int32s="frame_bits",
            float32s="signs steps pulse",
            complex64s="known explained points waves",
            uint8s="marks lead tail",
        ),
    ),
    "lora": (
        2,
        _fields(
            int32="shortest longest before chips spreading_factor code_bits step look head sync down fine sinc",
            float64="median_share limit threshold gain pace_gain certain",
            int32s="frame_bits telling words sync_word",
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
        ("mcs", ctypes.c_int64),
    )


class _FrameForm(ctypes.Structure):
    """The struct of the same name in ``frames.h``. It keeps the whitening sequence in memory."""

    _fields_ = (("multiple", ctypes.c_int32), ("high_first", ctypes.c_int32), ("mask", ctypes.c_void_p))

    def __init__(self, frames: Frames) -> None:
        self._mask = np.ascontiguousarray(frames.mask, np.uint8)
        super().__init__(frames.multiple, frames.order == "big", address(self._mask) if frames.plain else None)


class _Batch(ctypes.Structure):
    """The struct of the same name in ``stream.h``."""

    _fields_ = (
        ("frames", ctypes.c_void_p),
        ("count", ctypes.c_int64),
        ("gap", ctypes.c_int64),
        ("data", ctypes.c_char_p),
        ("lengths", ctypes.c_void_p),
        ("data_sizes", ctypes.c_void_p),
        ("sizes", ctypes.c_void_p),
        ("out", ctypes.c_void_p),
    )


class _Stream(ctypes.Structure):
    """The struct of the same name in ``stream.h``."""

    _fields_ = (
        ("samples", ctypes.c_void_p),
        ("count", ctypes.c_int64),
        ("frames", ctypes.c_void_p),
        *(
            (name, ctypes.c_int64)
            for name in ["margin", "span", "peak", "burst", "stretch", "cursor", "start", "last", "room"]
        ),
        *((name, ctypes.c_void_p) for name in ["packets", "lengths", "snrs", "ends", "soft", "points"]),
        *((name, ctypes.c_int64) for name in ["row_size", "row", "whole", "damaged"]),
        ("report", _Report),
        ("row_points", ctypes.c_int64),
    )


_NO_BURST, _READ, _CUT = range(3)
"""``Result`` of ``modem.h``."""


class CompiledModem(BurstModem):
    """The given modem, with modulation, search and demodulation by the compiled kernel.

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
        self.reading_size = constants.soft_bits, constants.points
        """Most soft bits and points of a reading."""
        self._samples_of = lru_cache(maxsize=None)(reference.samples_of)
        self._form = _FrameForm(reference.frames)
        given = reference.rates
        self._rates = tuple(CompiledModem(modem) for modem in given) if len(given) > 1 else ()

    def __reduce__(self) -> Any:
        return CompiledModem, (self._reference,)  # memory of a library stays in its process

    @property
    def rates(self) -> Sequence[BurstModem]:
        return self._rates or (self,)

    def samples_of(self, packet_len: int) -> int:
        return self._samples_of(packet_len)

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
        out = np.empty(self.samples_of(len(packet)), np.complex64)
        self.modulate_into([packet], 0, out)
        return out

    def modulate_into(self, packets: Sequence[bytes], gap: int, out: Samples) -> None:
        frames = self.frames
        data = packets if frames.plain else [frames.of(len(one)).wrap(one).tobytes() for one in packets]
        lengths, data_sizes = array("i", map(len, packets)), array("i", map(len, data))
        sizes = array("q", [self._samples_of(length) + gap for length in lengths])
        assert len(out) >= sum(sizes)
        arrays = (numbers.buffer_info()[0] for numbers in (lengths, data_sizes, sizes))
        batch = _Batch(ctypes.addressof(self._form), len(packets), gap, b"".join(data), *arrays, address(out))
        checked(self._functions.modem_modulate(self._kernel, ctypes.addressof(batch)))

    def receiver(self) -> BurstReceiver:
        return CompiledReceiver(self)

    def take(self, stream: _Stream) -> int:
        """Take packets from a stream until there is a reason to stop, which is returned.

        :raises MemoryError: when memory is short
        """
        stream.frames = ctypes.addressof(self._form)
        return checked(self._functions.modem_take(self._kernel, ctypes.addressof(stream)))

    def find(self, samples: Samples) -> Search:
        samples = np.ascontiguousarray(samples, np.complex64)
        start = ctypes.c_int64()
        found = self._functions.modem_find(self._kernel, address(samples), len(samples), ctypes.addressof(start))
        return Search(_counted(found), None if start.value == _NONE else start.value)

    def read(self, samples: Samples, start: int) -> Reading | None:
        samples = np.ascontiguousarray(samples, np.complex64)
        soft_bits, most_points = self.reading_size
        soft, points = np.empty(soft_bits, np.float32), np.empty(most_points, np.complex64)
        report = _Report()
        given = (address(samples), len(samples), start, address(soft), address(points), ctypes.addressof(report))
        result = checked(self._functions.modem_read(self._kernel, *given))
        if result == _NO_BURST:
            return None
        if result == _CUT:
            return Reading(report.length, None, points[:0], report.snr, report.end, report.mcs)
        read = (soft[: report.soft], points[: report.points])
        return Reading(report.length, *read, report.snr, report.end, report.mcs)


class CompiledReceiver(BurstReceiver):
    """A :class:`BurstReceiver` that takes all packets of its samples in one call, or one at a time where
    Python unwraps the frames.

    :param modem: modulation and frames
    """

    _modem: CompiledModem

    def __init__(self, modem: CompiledModem) -> None:
        super().__init__(modem)
        self._packets = ctypes.create_string_buffer(_ROOM * modem.frames.packet_len)
        self._lengths, self._newest_snrs = (ctypes.c_int32 * _ROOM)(), (ctypes.c_double * _ROOM)()
        self._ends = (ctypes.c_int64 * _ROOM)()
        soft, points = modem.reading_size
        self._soft, self._points = np.empty(soft, np.float32), np.empty((2, points), np.complex64)
        self._stream = stream = _Stream()
        stream.samples = address(self._buffer)
        stream.margin, stream.span = modem.margin, modem.span
        stream.peak, stream.burst, stream.stretch = modem.peak_samples, modem.burst_samples, self._stretch
        stream.room, stream.row_size = _ROOM, points
        stream.packets, stream.lengths = ctypes.addressof(self._packets), ctypes.addressof(self._lengths)
        stream.snrs, stream.ends = ctypes.addressof(self._newest_snrs), ctypes.addressof(self._ends)
        stream.soft, stream.points = address(self._soft), address(self._points)

    def _take(self) -> list[DemodulatedPacket]:
        stream = self._stream
        stream.count, stream.cursor = self._end, self._cursor
        stream.start = _NONE if self._start is None else self._start
        stream.last = _NONE if self._last is None else self._last
        packets: list[DemodulatedPacket] = []
        reason = None
        while reason != _NEEDS_SAMPLES:
            stream.whole = stream.damaged = 0
            reason = self._modem.take(stream)
            self.damaged += stream.damaged
            if stream.whole:
                packets += self._whole()
            if reason == _NOT_PLAIN:
                packets += self._unwrapped()
        self._cursor = stream.cursor
        start, last = stream.start, stream.last
        self._start, self._last = None if start == _NONE else start, None if last == _NONE else last
        return packets

    def _whole(self) -> list[DemodulatedPacket]:
        stream, packets = self._stream, []
        begin, count = stream.packets, stream.whole
        snrs = self._newest_snrs[:count]
        for length, snr, end in zip(self._lengths[:count], snrs, self._ends[:count], strict=True):
            packets.append(DemodulatedPacket(ctypes.string_at(begin, length), snr, self._counted(end)))
            begin += length
        self._measured(self._points[stream.row, : stream.row_points], snrs)
        return packets

    def _unwrapped(self) -> list[DemodulatedPacket]:
        """The packet of the burst that was read, if its CRC-32 matches."""
        stream, report = self._stream, self._stream.report
        frames = self._modem.rates[report.mcs].frames
        packet = frames.of(report.length).unwrap(self._soft[: report.soft])
        if packet is None:
            self.damaged += 1
            stream.cursor = stream.start + stream.peak
        else:
            stream.cursor = report.end - stream.margin
            self._measured(self._points[stream.row, : report.points], [report.snr])
        stream.start = stream.last = _NONE
        return [] if packet is None else [DemodulatedPacket(packet, report.snr, self._counted(report.end), report.mcs)]

    def _measured(self, points: Samples, snrs: list[float]) -> None:
        self.points = points.copy()
        self._remember(snrs)


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
            values.append(address(arrays[-1]))
    types = [(name, _NUMBERS.get(kind, ctypes.c_void_p)) for name, kind in fields.items()]
    struct = type("Parameters", (ctypes.Structure,), {"_fields_": types})(*values)
    kernel: int | None = functions.modem_new(number, ctypes.addressof(struct), ctypes.sizeof(struct))
    if kernel is None:
        raise MemoryError(f"no memory for the compiled kernel of {constants.kernel}, or it is of another version")
    return kernel


def _counted(result: int) -> int:
    if result == _NO_MEMORY:
        raise MemoryError("no memory for a compiled kernel to work in")
    return result
