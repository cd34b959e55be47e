"""Lets another Python import gr-ros2 and its requirements from a different environment.

`gr-ros2 grc-path --install` copies this file into the user's site-packages of GNU Radio's Python. A path file there
calls ``offer`` at every start. Invariants: until one of ``PACKAGES`` is imported, the finder finds only these, and only
if no other finder has found them; after that it also finds the packages of gr-ros2 that the other Python lacks or has
too old, and nothing else; modules that the process imported before stay unchanged.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from importlib.machinery import ModuleSpec, PathFinder
from typing import Any

PACKAGES = ("gr_ros2", "gr_ros2_lab")


class EnvironmentFinder:
    """Finds modules of one environment.

    :param folder: folder that contains ``PACKAGES``
    :param environment: site-packages of the environment
    :param modules: modules found there, by dotted names: top-level modules, and the parts of namespace packages
    :param packages: distributions of these modules, whose metadata is found too; normalised names (PEP 503)
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
        """Called by Python's import."""
        if name in PACKAGES:
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
        """Called by ``importlib.metadata``."""
        from importlib.metadata import DistributionFinder, MetadataPathFinder

        asked = None if context is None else context.name
        for name in self._packages if self._wanted else ():
            if asked is None or asked.lower().replace("_", "-").replace(".", "-") == name:
                inside = DistributionFinder.Context(name=name, path=[self._environment])
                yield from MetadataPathFinder.find_distributions(inside)


def offer(folder: str, environment: str, modules: Iterable[str], packages: Iterable[str]) -> None:
    """Let this Python find the modules; see :class:`EnvironmentFinder`."""
    sys.meta_path.append(EnvironmentFinder(folder, environment, modules, packages))
