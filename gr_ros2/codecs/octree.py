"""Sets of voxels as octrees: a byte for each occupied node says which of its eight children are occupied.

Invariants: equal sets give equal bytes; the first n levels of a tree are the tree of voxels that are coarser by a
factor of two for each level left out; decoding takes time in proportion to the nodes, of which there are at most as
many as bytes.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from gr_ros2.core.errors import DamagedError

Whole = npt.NDArray[Any]

MAX_LEVELS = 20
"""A side has at most 2**20 voxels."""
_SPREAD = (
    (32, 0x1F00000000FFFF), (16, 0x1F0000FF0000FF), (8, 0x100F00F00F00F00F), (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)  # fmt: skip
"""Shifts and masks that move 21 bits three apart; backwards they move them together."""


def numbers(places: Whole) -> Whole:
    """Morton numbers of cells, uint64 of shape (3, n), each coordinate 0..2**20 - 1: in their order, cells are in that
    of the tree."""
    found = np.zeros(places.shape[1], np.uint64)
    for axis in range(3):
        bits = places[axis]
        for shift, mask in _SPREAD:
            bits = (bits | bits << np.uint64(shift)) & np.uint64(mask)
        found |= bits << np.uint64(axis)
    return found


def cells(codes: Whole) -> Whole:
    """The cells of Morton numbers, shape (3, n)."""
    found = np.empty((3, len(codes)), np.int64)
    for axis in range(3):
        bits = codes >> np.uint64(axis) & np.uint64(_SPREAD[-1][1])
        for (shift, _), (_, mask) in zip(_SPREAD[::-1], (*_SPREAD[-2::-1], (0, 0x1FFFFF)), strict=True):
            bits = (bits | bits >> np.uint64(shift)) & np.uint64(mask)
        found[axis] = bits
    return found


def levels(codes: Whole, count: int) -> list[bytes]:
    """The bytes of each level, the root's first.

    :param codes: distinct Morton numbers of ``count`` bits for each axis, sorted; at least one if there are levels
    """
    found = []
    for _ in range(count):
        parents = codes >> np.uint64(3)
        begins = np.flatnonzero(np.concatenate(([True], parents[1:] != parents[:-1])))
        child = np.uint8(1) << (codes & np.uint64(7)).astype(np.uint8)
        found.append(np.bitwise_or.reduceat(child, begins).tobytes())
        codes = parents[begins]
    return found[::-1]


def leaves(tree: bytes, count: int, most: int) -> Whole:
    """The Morton numbers, sorted, of a tree of ``count`` levels.

    :param most: leaves that are accepted
    :raises DamagedError: bytes that are not such a tree, or too many leaves
    """
    codes, at = np.zeros(1, np.uint64), 0
    for _ in range(count):
        nodes = np.frombuffer(tree[at : at + len(codes)], np.uint8)
        at += len(codes)
        if len(nodes) < len(codes) or not nodes.all():
            raise DamagedError("damaged cloud: not an octree")
        bits = np.unpackbits(nodes, bitorder="little").reshape(-1, 8)
        if np.count_nonzero(bits) > most:
            raise DamagedError(f"damaged cloud: more than {most} points")
        parent, child = np.nonzero(bits)
        codes = codes[parent] << np.uint64(3) | child.astype(np.uint64)
    if at != len(tree):
        raise DamagedError("damaged cloud: an octree with more bytes than nodes")
    return codes
