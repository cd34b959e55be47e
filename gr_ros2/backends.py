"""Lazy tables of back-ends: name -> where its class lives and what must be installed for it.

Law: nothing behind a row is imported until that row is chosen, so `import gr_ros2` works without GNU Radio,
ROS 2 or a DDS.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from typing import Any

from gr_ros2.errors import BackendMissingError, ConfigError


@dataclass(frozen=True, slots=True)
class Backend:
    """One row: module and class, one line of help, and the package a user installs to get it."""

    module: str
    attribute: str
    summary: str
    requires: str = ""


class BackendTable(Mapping[str, Backend]):
    """A family of back-ends (middleware, PHY, scheduler), read by CLI, YAML, GRC options and docs alike."""

    def __init__(self, family: str, rows: Mapping[str, Backend]) -> None:
        self.family = family
        self._rows = dict(rows)

    def __getitem__(self, name: str) -> Backend:
        return self._rows[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._rows)

    def __len__(self) -> int:
        return len(self._rows)

    def load(self, name: str) -> Any:
        """The class behind a name.

        :raises ConfigError: for a name that is not in the table
        :raises BackendMissingError: when its package is not installed
        """
        if name not in self._rows:
            raise ConfigError(f"{self.family}: no {name!r}; known are {', '.join(self._rows)}")
        row = self._rows[name]
        try:
            with uninterrupted():
                return getattr(import_module(row.module), row.attribute)
        except ImportError as error:
            if not row.requires:
                raise
            raise BackendMissingError(f"{self.family} {name!r} needs {row.requires} ({error})") from error


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Ctrl-C and SIGTERM wait until what is inside is done, for instance an import.

    KeyboardInterrupt inside a C extension that is being loaded comes out as ImportError or RuntimeError, or leaves it
    half loaded. Where it is not the main thread that asks, nothing is to be done: signals are handled there alone.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: dict[int, None] = {}
    found = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    handlers = {number: handler for number, handler in found.items() if handler is not None}  # None: not Python's
    try:
        for number in handlers:
            signal.signal(number, lambda number, _: came.setdefault(number))
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        for waiting in came:
            signal.raise_signal(waiting)
