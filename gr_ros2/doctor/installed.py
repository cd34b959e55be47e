"""Checks of what is installed: the parts that every link needs, and those that only some links need.

Invariant: GNU Radio is imported in a separate process, because one that was built for another numpy may end it.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from gr_ros2 import __version__
from gr_ros2.core.backends import BackendTable
from gr_ros2.core.errors import BackendMissingError, PhyError
from gr_ros2.core.preferences import check_preferences
from gr_ros2.doctor.finding import Finding
from gr_ros2.doctor.programs import output_of
from gr_ros2.grc.python import finds_us, grc_program
from gr_ros2.middleware import MIDDLEWARE
from gr_ros2.phy import PHY
from gr_ros2.phy.kernels.library import loaded
from gr_ros2.radio import FRONT_ENDS
from gr_ros2.settings.config import DEFAULT_MIDDLEWARE

OLDEST, NEWEST = (3, 10), (3, 14)
"""Oldest and newest Python version on which this program was run."""
GNU_RADIO = "3.10."
_SYSTEM = "/usr/bin/python3 -m venv --system-site-packages .venv"
_ASK = "from gnuradio import gr; import pmt; print('version', gr.version())"
_PARTS = {
    "bokeh": ("the live dashboard", "pip install 'gr-ros2[dashboard]'"),
    "distributed": ("sweeps on a cluster", "pip install 'gr-ros2[sweep]'"),
}
"""Optional packages by import name: their purpose, and the command that installs them."""


def python() -> Finding:
    """Whether the program was run on this version of Python."""
    text = f"{'.'.join(map(str, sys.version_info[:3]))}, {sys.executable}; gr-ros2 {__version__}"
    if OLDEST <= sys.version_info[:2] <= NEWEST:
        return Finding("Python", "ok", text)
    known = " to ".join(".".join(map(str, version)) for version in (OLDEST, NEWEST))
    return Finding("Python", "warning", f"{text}; tried with {known}", _SYSTEM)


def gnu_radio() -> Finding:
    """Whether GNU Radio can be imported here, and its version is 3.10."""
    output = output_of([sys.executable, "-c", _ASK]) or ""
    version = next((line.split()[1] for line in output.splitlines() if line.startswith("version ")), None)
    if version is None:
        last = (output.strip().splitlines() or ["it ended without a word"])[-1]
        there = any(Path(folder, "gnuradio").is_dir() for folder in Path("/usr/lib").glob("python3*/dist-packages"))
        remedy = f"make the environment from the system's Python: {_SYSTEM}" if there else "sudo apt install gnuradio"
        return Finding("GNU Radio", "failed", f"cannot be imported ({last})", remedy)
    if version.startswith(GNU_RADIO):
        try:
            check_preferences()
        except PhyError as error:
            what, _, remedy = str(error).partition("; ")
            return Finding("GNU Radio", "failed", f"{version}; {what}", remedy)
        return Finding("GNU Radio", "ok", version)
    return Finding("GNU Radio", "failed", f"{version}; this needs {GNU_RADIO}x", "sudo apt install gnuradio")


def kernels() -> Finding:
    """Whether the modems use compiled code."""
    found = loaded()
    if found.functions is None:
        text = f"none, numpy does their work, slower: {found.about}"
        return Finding("compiled kernels", "warning", text, "sudo apt install g++; then install gr-ros2 again")
    return Finding("compiled kernels", "ok", f"yes, for {found.about}")


def middleware() -> Iterator[Finding]:
    """The ROS graphs that can be joined."""
    return _backends(MIDDLEWARE, needed=DEFAULT_MIDDLEWARE)


def phys() -> Iterator[Finding]:
    """The physical layers that can be used."""
    return _backends(PHY)


def front_ends() -> Iterator[Finding]:
    """The radio front ends whose software is installed."""
    return _backends(FRONT_ENDS)


def companion() -> Finding:
    """Whether flowgraphs that run in the Python of GNU Radio Companion find the blocks."""
    program = grc_program()
    if finds_us(program):
        return Finding("GRC", "ok", f"{program} finds gr-ros2")
    return Finding("GRC", "note", f"{program} does not find gr-ros2", "gr-ros2 grc-path --install")


def parts() -> Iterator[Finding]:
    """Optional packages."""
    for module, (purpose, remedy) in _PARTS.items():
        if find_spec(module) is None:
            yield Finding(module, "note", f"not installed; it is for {purpose}", remedy)
        else:
            yield Finding(module, "ok", f"for {purpose}")


def _backends(table: BackendTable[Any], needed: str = "") -> Iterator[Finding]:
    for name in table:
        what = f"{table.family} {name}"
        try:
            table.load(name)
            table.modules(name)
            yield Finding(what, "ok", table[name].summary)
        except BackendMissingError as error:
            remedy = table[name].requires if name in table.own else ""
            yield Finding(what, "failed" if name == needed else "note", f"cannot be used: {error.__cause__}", remedy)
