"""Decoders of the codes that release Python's lock while they work.

Invariants: the codes are those of GNU Radio's encoders; the decoders of block codes differ from GNU Radio's in rounding
only. That of the convolutional code is up to 0.2 dB better, since it does not limit the costs of paths to 8 bits.
"""

from __future__ import annotations

import ctypes
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gr_ros2.phy.fec import LDPC_ROUNDS, POLYNOMIALS, Bits, Decoder
from gr_ros2.phy.kernels.library import address, checked, loaded


class _Checks(ctypes.Structure):
    """The struct of the same name in ``codes.h``. It keeps its arrays in memory."""

    _fields_ = (
        *((name, ctypes.c_int32) for name in ("bit_count", "check_count", "rounds")),
        *((name, ctypes.c_void_p) for name in ("check_begins", "bits", "bit_begins", "places")),
    )

    def __init__(self, bits_of_checks: list[list[int]], bit_count: int) -> None:
        bits = np.concatenate(bits_of_checks).astype(np.int32)
        self._kept = (
            _begins([len(one) for one in bits_of_checks]),
            bits,
            _begins(np.bincount(bits, minlength=bit_count)),
            np.argsort(bits, kind="stable").astype(np.int32),
        )
        super().__init__(bit_count, len(bits_of_checks), LDPC_ROUNDS, *map(address, self._kept))


class CompiledDecoders:
    """The decoders of :mod:`gr_ros2.phy.fec` in C++, which do not hold Python's lock."""

    def convolutional(self, bits: int) -> Decoder:
        polynomials = np.array(POLYNOMIALS, np.int32)

        def decode(levels: NDArray[Any]) -> Bits:
            out = np.empty(bits, np.uint8)
            levels = _given(levels, np.uint8, 2 * bits + 12)
            checked(loaded().functions.decode_convolutional(address(levels), bits, address(polynomials), address(out)))
            return out

        return decode

    def ldpc(self, path: Path, data_bits: int) -> Decoder:
        bits_of_checks, bit_count = _alist(path)
        checks = _Checks(bits_of_checks, bit_count)

        def decode(soft: NDArray[Any]) -> Bits:
            out = np.empty(bit_count, np.uint8)
            soft = _given(soft, np.float32, bit_count)
            checked(loaded().functions.decode_ldpc(ctypes.addressof(checks), address(soft), address(out)))
            return out[bit_count - data_bits :]

        return decode

    def polar(self, size: int, frozen: list[int]) -> Decoder:
        known = np.zeros(size, np.uint8)
        known[frozen] = 1
        free = np.flatnonzero(known == 0)
        bits = size.bit_length() - 1
        # GNU Radio sends the bits in the order of their reversed numbers.
        order = np.array([int(f"{number:0{bits}b}"[::-1], 2) for number in range(size)])

        def decode(soft: NDArray[Any]) -> Bits:
            out = np.empty(size, np.uint8)
            soft = _given(soft[order], np.float32, size)
            checked(loaded().functions.decode_polar(size, address(soft), address(known), address(out)))
            return out[free]

        return decode


def _given(values: NDArray[Any], dtype: Any, size: int) -> NDArray[Any]:
    if len(values) != size:
        raise ValueError(f"{len(values)} soft values; this decoder takes {size}")
    return np.ascontiguousarray(values, dtype)


def _begins(sizes: Any) -> NDArray[np.int32]:
    """Where each part begins and the last one ends, in an array of parts of these sizes."""
    return np.concatenate(([0], np.cumsum(sizes))).astype(np.int32)


def _alist(path: Path) -> tuple[list[list[int]], int]:
    """The bits of each check, and the number of bits, of a parity-check matrix in the alist format (MacKay)."""
    lines = [[int(number) for number in line.split()] for line in path.read_text("ascii").splitlines()]
    bit_count, check_count = lines[0]
    # Sizes of the parts come first, then the checks of each bit, then the bits of each check; 0 fills up a line.
    rows = lines[4 + bit_count : 4 + bit_count + check_count]
    return [[number - 1 for number in row if number] for row in rows], bit_count
