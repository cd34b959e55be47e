"""Finds the C library of Cyclone DDS: in PyPI's cyclonedds 11.0, or in the wheel of gr-ros2.

Invariant: the Python part of that package is not imported. It does not exist for Python 3.14, while the C library works
with every Python; for Python versions without cyclonedds on PyPI, setup.py puts the library next to this module.
"""

from __future__ import annotations

import ctypes
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from runpy import run_path

VERSION = "11.0."
"""First part of the version for which the calls are written."""


def load() -> ctypes.CDLL:
    """The library, loaded.

    :raises ImportError: the library is missing, or has another version
    """
    try:
        return ctypes.CDLL(_path())
    except OSError as error:
        raise ImportError(f"the library of Cyclone DDS does not load: {error}") from error


def _path() -> str:
    ours = find_spec(f"{__package__}.libddsc")
    if ours is not None and ours.origin is not None:
        return ours.origin
    if not (found := version("cyclonedds")).startswith(VERSION):
        raise ImportError(f"cyclonedds {found} is installed, whose layouts differ from those of version {VERSION}x")
    package = find_spec("cyclonedds")
    if package is None or package.origin is None:
        raise ImportError("cyclonedds is installed without its Python package; install it again")
    # There the package says where its library is, that of a wheel or one that was built on this machine.
    return str(run_path(str(Path(package.origin).with_name("__library__.py")))["library_path"])
