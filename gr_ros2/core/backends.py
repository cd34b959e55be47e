"""Lazy tables of back-ends: name -> where its class lives and what must be installed for it.

Invariants: nothing of a back-end is imported until it is chosen, so `import gr_ros2` works without GNU Radio, ROS
2 or a DDS; other packages add back-ends by entry points, which are read only when a name is not in this table, or
when all names are listed; a broken entry point fails only for the user who chooses it.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from typing import Any, Generic, TypeVar

from gr_ros2.core.errors import BackendMissingError, ConfigError


@dataclass(frozen=True)
class Backend:
    """One back-end.

    :param module: dotted name of the module
    :param attribute: the class in it
    :param summary: one line of help
    :param requires: the package a user installs to get it, '' = nothing beside this one
    :param title: what GRC calls it, '' = its name in capitals
    :param imports: Python modules that it needs when it is used, but not for its settings to be known
    """

    module: str
    attribute: str
    summary: str
    requires: str = ""
    title: str = ""
    imports: tuple[str, ...] = ()


BackendT = TypeVar("BackendT", bound=Backend)


class BackendTable(Mapping[str, BackendT], Generic[BackendT]):
    """A family of back-ends (middleware, PHY, …). CLI, YAML, GRC options and docs all read this table.

    Other packages add to it by entry points of the group ``gr_ros2.FAMILY``, in their ``pyproject.toml`` for instance::

        [project.entry-points."gr_ros2.phy"]
        ook = "my_package.ook:OokPhy"

    The entry point names either the class (the :class:`Backend` then has default values) or a Backend.

    :param family: what errors call a back-end, and the last part of the group
    :param backends: those of this package, by name; an entry point cannot replace them
    :param kind: class of a back-end
    """

    def __init__(self, family: str, backends: Mapping[str, BackendT], kind: type[BackendT]) -> None:
        self.family = family
        self.own: Mapping[str, BackendT] = dict(backends)
        """Those of this package, without those of others."""
        self._kind = kind

    def __getitem__(self, name: str) -> BackendT:
        """The back-end of a name.

        :raises KeyError: for a name that is not in the table
        :raises BackendMissingError: when the entry point that has this name cannot be loaded
        """
        return self.own[name] if name in self.own else self._backend_of(self._others[name])

    def __iter__(self) -> Iterator[str]:
        yield from self.own
        yield from self._others

    def __len__(self) -> int:
        return len(self.own) + len(self._others)

    def __contains__(self, name: object) -> bool:
        return name in self.own or name in self._others

    def load(self, name: str) -> Any:
        """The class behind a name.

        :raises ConfigError: for a name that is not in the table
        :raises BackendMissingError: when its package is not installed, or the entry point that names it is broken
        """
        if name not in self:
            raise ConfigError(f"{self.family}: no {name!r}; known are {', '.join(self)}")
        backend = self[name]
        return getattr(self._imported(name, backend, backend.module), backend.attribute)

    def modules(self, name: str) -> tuple[Any, ...]:
        """The modules that a back-end needs when it is used, see ``Backend.imports``.

        :param name: a name of the table
        :raises BackendMissingError: when one is not installed
        """
        backend = self[name]
        return tuple(self._imported(name, backend, module) for module in backend.imports)

    def _imported(self, name: str, backend: BackendT, module: str) -> Any:
        try:
            with uninterrupted():
                return import_module(module)
        except ImportError as error:
            if not backend.requires:
                raise
            raise BackendMissingError(f"{self.family} {name!r} needs {backend.requires} ({error})") from error

    @cached_property
    def _others(self) -> Mapping[str, EntryPoint]:
        """Entry points of other packages; where two have one name, the first found."""
        found: dict[str, EntryPoint] = {}
        for entry in entry_points(group=f"gr_ros2.{self.family}"):
            if entry.name not in self.own:
                found.setdefault(entry.name, entry)
        return found

    def _backend_of(self, entry: EntryPoint) -> BackendT:
        package = "?" if entry.dist is None else entry.dist.metadata["Name"]
        try:
            with uninterrupted():
                loaded = entry.load()
        except Exception as error:  # code of another package may raise anything; the user gets one line
            raise BackendMissingError(
                f"{self.family} {entry.name!r}: package {package} has it as {entry.value}, which cannot be loaded "
                f"({type(error).__name__}: {error}); mend or remove that package"
            ) from error
        if isinstance(loaded, self._kind):
            return loaded
        if not isinstance(loaded, type):
            raise BackendMissingError(
                f"{self.family} {entry.name!r}: package {package} has it as {entry.value}, which is neither a class "
                f"nor a {self._kind.__name__}; mend or remove that package"
            )
        return self._kind(entry.module, entry.attr, f"of package {package}")


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Delay Ctrl-C and SIGTERM until the body of the ``with`` statement is done, for instance an import.

    KeyboardInterrupt inside a C extension that is being loaded comes out as ImportError or RuntimeError, or leaves it
    half loaded. In any other thread than the main thread this does nothing: Python handles signals in the main thread
    only.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: dict[int, None] = {}
    found = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
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
