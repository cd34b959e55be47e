"""Transforms of long arrays that help zstd: bytes of equal significance side by side, differences, decimals.

Each array names its transform: PLAIN, PLANES (byte 0 of all elements, then byte 1, ...), DELTAS (differences of
neighbouring elements, modulo their width, zigzag-coded and as planes), DECIMALS (float32 of the form n / 10**k: 5 + the
zigzag-coded differences of the n, as planes; 0..4 stand for infinities and other special values).

Invariants: little endian in and out; exact for all bytes; the inverse never yields more bytes than the given size, and
raises only ValueError.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

_Whole = npt.NDArray[Any]

PLAIN, PLANES, DELTAS, DECIMALS = range(4)
_UNSIGNED = {1: "<u1", 2: "<u2", 4: "<u4", 8: "<u8"}
_SPECIAL = np.array([0x7F800000, 0xFF800000, 0x7FC00000, 0xFFC00000, 0x80000000], dtype="<u4")
"""Infinities, common NaNs and -0.0 have the codes 0..4 among the differences."""
_MAX_N = 1 << 24


def transform(data: bytes, size: int, real: bool, compressed: Callable[[bytes], int]) -> tuple[int, int, bytes]:
    """(transform, parameter, transformed bytes) of the transform that compresses best.

    :param size: bytes of an element
    :param real: elements are floating point
    :param compressed: a measure: the size after compression
    """
    found = list(_candidates(data, size, real))
    if len(found) == 1:
        return found[0]
    return min(found, key=lambda candidate: compressed(candidate[2]))


def _candidates(data: bytes, size: int, real: bool) -> Iterator[tuple[int, int, bytes]]:
    if size > 1 and real and size == 4:
        decimals = _decimals(data)
        if decimals is not None:
            yield decimals
            return
    yield PLAIN, 0, data
    if size > 1:
        yield PLANES, size, _to_planes(data, size)
        yield DELTAS, size, _to_planes(_differences(np.frombuffer(data, _UNSIGNED[size])).tobytes(), size)


def inverse_transform(way: int, parameter: int, data: bytes, size: int) -> bytes:
    """The original array.

    :raises ValueError: unknown transform, or an incomplete element
    """
    if way == PLAIN:
        return data
    # DECIMALS are of float32 and have their own parameter; the others repeat the size.
    fits = size == 4 if way == DECIMALS else parameter == size and way < DECIMALS
    if size == 1 or len(data) % size or not fits:
        raise ValueError(f"way {way} with {parameter} for {len(data)} bytes of elements of {size}")
    data = _from_planes(data, size)
    if way == PLANES:
        return data
    whole = np.frombuffer(data, _UNSIGNED[size])
    if way == DECIMALS:
        return _from_decimals(whole, parameter)
    return np.cumsum(_unfolded(whole), dtype=_UNSIGNED[size]).tobytes()


def _to_planes(data: bytes, size: int) -> bytes:
    return b"".join(data[place::size] for place in range(size))


def _from_planes(data: bytes, size: int) -> bytes:
    count = len(data) // size
    out = bytearray(len(data))
    for place in range(size):
        out[place::size] = data[place * count : (place + 1) * count]
    return bytes(out)


def _differences(values: _Whole) -> _Whole:
    """Differences of neighbours, zigzag-coded so that small differences of either sign are small numbers."""
    out = values.copy()
    out[1:] -= values[:-1]
    signed = out.view(out.dtype.str.replace("u", "i"))
    folded: _Whole = out << 1 ^ (signed >> (8 * out.itemsize - 1)).view(out.dtype)
    return folded


def _unfolded(values: _Whole) -> _Whole:
    one = values.dtype.type(1)
    unfolded: _Whole = values >> one ^ (~(values & one) + one)
    return unfolded


def _decimals(data: bytes) -> tuple[int, int, bytes] | None:
    """Differences of n with the fewest decimals k <= 4, None where some element is not such a number."""
    bits = np.frombuffer(data, "<u4")
    special = np.isin(bits, _SPECIAL)
    with np.errstate(all="ignore"):
        values = np.where(special, np.uint32(0), bits).view("<f4").astype(np.float64)
        if not np.all(np.abs(values) < _MAX_N):
            return None
        for k in range(5):
            n = np.rint(values * 10**k)
            if np.all(np.abs(n) < _MAX_N) and np.array_equal(
                (n / 10**k).astype("<f4").view("<u4")[~special], bits[~special]
            ):
                kept = n[~special].astype("<i4").view("<u4")
                out = np.empty(len(bits), "<u4")
                for code, value in enumerate(_SPECIAL.tolist()):
                    out[bits == value] = code
                out[~special] = _differences(kept) + np.uint32(len(_SPECIAL))
                return DECIMALS, k, _to_planes(out.tobytes(), 4)
    return None


def _from_decimals(codes: _Whole, k: int) -> bytes:
    if k > 4:
        raise ValueError(f"{k} decimals")
    special = codes < len(_SPECIAL)
    bits = np.empty(len(codes), "<u4")
    bits[special] = _SPECIAL[codes[special]]
    n = np.cumsum(_unfolded(codes[~special] - np.uint32(len(_SPECIAL))), dtype="<u4").view("<i4")
    bits[~special] = (n / 10**k).astype("<f4").view("<u4")
    return bytes(bits.tobytes())


def swapped(data: bytes, size: int) -> bytes:
    """Each element's bytes reversed."""
    return np.frombuffer(data, _UNSIGNED[size]).byteswap().tobytes() if size > 1 else data
