"""Bounded loss, where the user configures it: numbers are rounded to a number of decimals before they are coded.

Invariant: a finite x of magnitude below 2**33 steps becomes the double (or float32) nearest to a multiple of the step,
so it is off by at most step * (1/2 + 2**-20), plus half a unit in the last place of a float32; every other value (NaN,
infinities, larger ones) and every field not named stays as it is, bit for bit. The decoder does not need to know about
quantisation.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from gr_ros2.compression.layout import BULK, DOUBLE, MATRIX, QUATERNION, SINGLE, Layout, Slot
from gr_ros2.compression.schema import BIG, Composite, Node, Repeat, Scalar
from gr_ros2.core.errors import ConfigError

LARGEST = float(1 << 33)
"""Largest magnitude in steps; larger values stay unchanged."""
_MAX_DECIMALS = 6


def parse_steps(text: str) -> dict[str, int]:
    """``pose.pose.position=0.001 ranges=0.01`` as decimals by path; separated by blanks, commas or semicolons.

    :raises ConfigError: no path=step, or a step that is not 1, 0.1, ... 0.000001
    """
    steps: dict[str, int] = {}
    for part in text.replace(",", " ").replace(";", " ").split():
        path, _, step = part.partition("=")
        decimals = next((k for k in range(_MAX_DECIMALS + 1) if _is(step, 10**-k)), None)
        if not path or decimals is None:
            raise ConfigError(f"quantize = {part!r}: write path=step with a step of 1, 0.1, 0.01 ... 0.000001")
        steps[path] = decimals
    return steps


def _is(text: str, value: float) -> bool:
    try:
        return math.isclose(float(text), value, rel_tol=1e-9)
    except ValueError:
        return False


class Quantizer:
    """Rounds the chosen fields of one type.

    :param steps: decimals by path; a path includes all fields below it
    :raises ConfigError: for a path under which there is no floating-point field
    """

    def __init__(self, tree: Composite, steps: Mapping[str, int]) -> None:
        known = list(_float_paths(tree, ""))
        for path in steps:
            if not any(_below(path, leaf) for leaf in known):
                raise ConfigError(
                    f"quantize = {path!r}: {tree.type_name} has no floating-point field of that name; "
                    f"it has {', '.join(known) or 'none'}"
                )
        self._steps = dict(steps)

    def __call__(self, layout: Layout, values: tuple[Any, ...]) -> bytes:
        """The payload with its chosen fields rounded."""
        out = list(values)
        order = layout.shape.order
        for slot in [*layout.outline.live, *layout.outline.static_values]:
            if slot.kind in (DOUBLE, QUATERNION):
                for place in range(4 if slot.kind == QUATERNION else 1):
                    decimals = self._decimals(slot, "xyzw"[place] if slot.kind == QUATERNION else "")
                    if decimals is not None:
                        out[slot.index + place] = _rounded(out[slot.index + place], decimals, "d", "Q")
            elif slot.kind == SINGLE:
                if (decimals := self._decimals(slot)) is not None:
                    out[slot.index] = _rounded(out[slot.index], decimals, "f", "I")
            elif (
                slot.kind in (BULK, MATRIX)
                and (decimals := self._decimals(slot)) is not None
                and (slot.kind == MATRIX or slot.real >= 0)
            ):
                size = 8 if slot.kind == MATRIX else slot.size
                out[slot.index] = _rounded_array(out[slot.index], decimals, f"{'>' if order == BIG else '<'}f{size}")
        return layout.pack(*out)

    def _decimals(self, slot: Slot, component: str = "") -> int | None:
        leaf = f"{slot.path}.{component}" if component else slot.path
        return next((decimals for path, decimals in self._steps.items() if _below(path, leaf)), None)


def _below(path: str, leaf: str) -> bool:
    return leaf == path or leaf.startswith((f"{path}.", f"{path}[]"))


def _rounded(bits: int, decimals: int, real: str, whole: str) -> int:
    value: float = struct.unpack("<" + real, struct.pack("<" + whole, bits))[0]
    scaled = value * 10**decimals
    if not -LARGEST < scaled < LARGEST:
        return bits
    out: int = struct.unpack("<" + whole, struct.pack("<" + real, round(scaled) / 10**decimals))[0]
    return out


def _rounded_array(data: bytes, decimals: int, dtype: str) -> bytes:
    values = np.frombuffer(data, dtype)
    with np.errstate(all="ignore"):
        wide = values.astype("f8")
        scaled = wide * 10**decimals
        chosen = np.abs(scaled) < LARGEST
        rounded = (np.rint(np.where(chosen, scaled, 0.0)) / 10**decimals + 0.0).astype(dtype)
    return (
        np.where(chosen, rounded.view(dtype.replace("f", "u")), values.view(dtype.replace("f", "u")))
        .astype(dtype.replace("f", "u"))
        .tobytes()
    )


def _float_paths(node: Node, path: str) -> Iterator[str]:
    if isinstance(node, Scalar):
        if node.code in "df":
            yield path
    elif isinstance(node, Repeat):
        yield from _float_paths(node.element, path if isinstance(node.element, Scalar) else path + "[]")
    elif isinstance(node, Composite):
        for name, member in node.members:
            yield from _float_paths(member, f"{path}.{name}" if path else name)
