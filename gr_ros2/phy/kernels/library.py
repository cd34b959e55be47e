"""Loads the library of compiled kernels: the variant for this processor, or the reason why there is none.

Invariants: a missing library, or one that does not load, is not an error but a reason in words; a library is loaded
once, and changes nothing else in the process.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from functools import lru_cache
from importlib.machinery import EXTENSION_SUFFIXES
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

_FOLDER = Path(__file__).parent
_EVERYWHERE, _AVX2 = "_baseline", "_avx2"
"""Names of the variants' files, as setup.py has them: for every processor of the architecture, and for a newer one."""
VERSION = 8
"""Version of ``abi.cpp``. A library that was built before a change of it is not used."""
_POINTER, _INT, _LONG = ctypes.c_void_p, ctypes.c_int, ctypes.c_int64
_SIGNATURES: dict[str, tuple[Any, list[Any]]] = {
    "kernels_version": (_INT, []),
    "kernels_target": (ctypes.c_char_p, []),
    "kernels_has_avx2": (_INT, []),
    "modem_new": (_POINTER, [_INT, _POINTER, _LONG]),
    "modem_free": (None, [_POINTER]),
    "modem_find": (_LONG, [_POINTER, _POINTER, _LONG, _POINTER]),
    "modem_read": (_INT, [_POINTER, _POINTER, _LONG, _LONG, _POINTER, _POINTER, _POINTER]),
    "modem_take": (_INT, [_POINTER, _POINTER]),
    "modem_modulate": (_INT, [_POINTER, _POINTER]),
    "decode_convolutional": (_INT, [_POINTER, _LONG, _POINTER, _POINTER]),
    "decode_ldpc": (_INT, [_POINTER, _POINTER, _POINTER]),
    "decode_polar": (_INT, [_INT, _POINTER, _POINTER, _POINTER]),
}
"""Result and arguments of each function of ``abi.cpp``."""


@dataclass(frozen=True)
class Loaded:
    """Result of loading the library.

    :param functions: the functions of ``abi.cpp``, None if there is no library
    :param about: what they were compiled for, such as ``AVX2``, or why there are none
    """

    functions: Any
    about: str


@lru_cache(maxsize=1)
def loaded() -> Loaded:
    """The variant for this processor."""
    return load(_FOLDER)


def load(folder: Path) -> Loaded:
    """The variant for this processor out of a folder."""
    baseline = _file(folder, _EVERYWHERE)
    if baseline is None:
        return Loaded(None, "they were not built; install a C++ compiler (apt install g++), then install gr-ros2 again")
    try:
        functions = _open(baseline)
        newer = _file(folder, _AVX2)
        if newer is not None and functions.kernels_has_avx2():
            functions = _open(newer)
    except (OSError, AttributeError) as error:  # built for another machine, or by another version
        return Loaded(None, f"they do not load ({error}); install gr-ros2 again")
    return Loaded(functions, functions.kernels_target().decode())


def _file(folder: Path, variant: str) -> Path | None:
    return next((path for suffix in EXTENSION_SUFFIXES if (path := folder / f"{variant}{suffix}").is_file()), None)


def _open(path: Path) -> Any:
    functions = ctypes.CDLL(str(path))  # its calls release Python's lock
    for name, (result, arguments) in _SIGNATURES.items():
        function = getattr(functions, name)
        function.restype, function.argtypes = result, arguments
    if functions.kernels_version() != VERSION:
        raise OSError(f"{path.name} is of version {functions.kernels_version()}, not {VERSION}")
    return functions


def address(array: NDArray[Any]) -> int:
    """Where an array's values are."""
    place: int = array.__array_interface__["data"][0]  # three times as fast as array.ctypes
    return place


def checked(result: int) -> int:
    """The result of a function.

    :raises MemoryError: when memory was short
    """
    if result < 0:
        raise MemoryError("no memory for a compiled kernel to work in")
    return result
