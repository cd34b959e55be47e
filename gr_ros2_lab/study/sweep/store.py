"""The finished runs of a sweep in its folder, one file each, so that no run is done twice.

Invariants: the name of a file depends on everything that determines the result (every setting, the bytes of registry
and dictionaries, size and time of the recording, the version of gr-ros2), so no other run has the same name; the file
appears whole or not at all.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from gr_ros2 import __version__
from gr_ros2.core.errors import ConfigError
from gr_ros2_lab.record.result import Result, read_result, write_result
from gr_ros2_lab.run.scenario import Scenario, dump

RUNS = "runs"
"""Folder of the finished runs, inside the sweep's."""

_KEY_CHARACTERS = 32


class Store:
    """The finished runs of one folder.

    :param folder: of the sweep; made when the first run is kept
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder / RUNS

    def find(self, key: str) -> Result | None:
        """The result of a run, None where it has not been run.

        :raises ConfigError: when its file is damaged; names the file
        """
        path = self._path(key)
        if not path.exists():
            return None
        try:
            return read_result(path)
        except ConfigError as error:
            raise ConfigError(f"{error}, or delete the file: then this one run is repeated") from error

    def keep(self, key: str, result: Result) -> None:
        """Write the result of a run.

        :raises ConfigError: when it cannot be written
        """
        write_result(result, self._path(key))

    def _path(self, key: str) -> Path:
        return self._folder / f"{key}.json"


def run_key(scenario: Scenario) -> str:
    """The name of a run's file."""
    # Files are identified by their contents, not by their paths. A description changes nothing.
    settings = {key: value for key, value in without_registry(dump(scenario)).items() if key != "description"}
    identity = {"version": __version__, "settings": settings, "files": list(_files(scenario))}
    return hashlib.sha256(json.dumps(identity, sort_keys=True).encode()).hexdigest()[:_KEY_CHARACTERS]


def without_registry(settings: Any) -> Any:
    """The same settings without the path of the registry, which occurs in several places."""
    if not isinstance(settings, dict):
        return settings
    return {key: without_registry(value) for key, value in settings.items() if key != "registry"}


def _files(scenario: Scenario) -> Iterator[Any]:
    path = Path(scenario.registry).expanduser()
    yield hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else scenario.registry
    if (bag := scenario.bag_path) is not None:
        for path in sorted(bag.rglob("*")) if bag.is_dir() else [bag]:
            if path.is_file():
                yield path.name, path.stat().st_size, path.stat().st_mtime_ns
