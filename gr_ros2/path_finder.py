"""Lets another Python import gr-ros2, and what it needs, from an environment that is not its own.

`gr-ros2 grc-path --install` copies this file into the user's site-packages of GNU Radio's Python, where a path file
calls ``offer`` at every start. Invariants: it finds ``gr_ros2`` alone, and only when nobody else has, until that is
imported; from then on it also finds the packages of gr-ros2 that the other Python lacks or has too old, and nothing
else; what the process has imported before stays as it is.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from importlib.machinery import ModuleSpec, PathFinder
from typing import Any

PACKAGE = "gr_ros2"


class EnvironmentFinder:
    """Finds modules of one environment.

    :param folder: that has the package ``gr_ros2``
    :param environment: site-packages of the environment
    :param modules: what is found there, by dotted names: top-level modules, and the parts of namespace packages
    :param packages: the distributions these are of, whose metadata is found too; plain names (PEP 503)
    """

    def __init__(self, folder: str, environment: str, modules: Iterable[str], packages: Iterable[str]) -> None:
        self._folder, self._environment = folder, environment
        self._modules, self._packages = frozenset(modules), frozenset(packages)
        self._wanted = False

    def find_spec(
        self,
        name: str,
        path: Sequence[str] | None = None,  # noqa: ARG002 - import's signature
        target: Any = None,
    ) -> ModuleSpec | None:
        """What Python's import asks a finder."""
        if name == PACKAGE:
            found = PathFinder.find_spec(name, [self._folder], target)
            if found is not None and not self._wanted:
                self._wanted = True
                sys.meta_path.remove(self)
                sys.meta_path.insert(0, self)
            return found
        if not self._wanted or name not in self._modules:
            return None
        place = "/".join([self._environment, *name.split(".")[:-1]])
        found = PathFinder.find_spec(name, [place], target)
        if found is not None and found.loader is None and found.submodule_search_locations is not None:
            # A namespace package would look for its parts along sys.path, where this environment is not.
            found.submodule_search_locations = list(found.submodule_search_locations)
        return found

    def find_distributions(self, context: Any = None) -> Iterable[Any]:
        """What ``importlib.metadata`` asks a finder."""
        from importlib.metadata import DistributionFinder, MetadataPathFinder

        asked = None if context is None else context.name
        for name in self._packages if self._wanted else ():
            if asked is None or asked.lower().replace("_", "-").replace(".", "-") == name:
                inside = DistributionFinder.Context(name=name, path=[self._environment])
                yield from MetadataPathFinder.find_distributions(inside)


def offer(folder: str, environment: str, modules: Iterable[str], packages: Iterable[str]) -> None:
    """Let this Python find them; see :class:`EnvironmentFinder`."""
    sys.meta_path.append(EnvironmentFinder(folder, environment, modules, packages))
