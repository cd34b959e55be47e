"""YAML files of settings: reads one file, finds its registries, and replaces settings given on the command line.

Invariants: a relative path of a registry or trace in a file is relative to that file, one on the command line to the
current directory; overrides apply in their order; only the form is checked here, since the settings classes check their
own ranges.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from gr_ros2.core.errors import ConfigError
from gr_ros2.settings.config import read_yaml
from gr_ros2.settings.fields import AUTO
from gr_ros2.settings.topic_choice import topics_of
from gr_ros2.settings.yaml_text import parse_yaml

REGISTRY_DIR = Path(__file__).resolve().parent.parent / "registries"
"""Folder of the built-in registries."""

_FILES = ("key", "state")
"""Settings that are files, which need not exist yet."""

_NUMBER = re.compile(r"[-+]?[0-9]+(\.[0-9]*)?[eE][-+]?[0-9]+")


def read_settings(path: Path, overrides: Sequence[str] = ()) -> dict[str, Any]:
    """The settings of a YAML file; their name is that of the file unless the file sets one.

    :param overrides: `key=value` with dotted keys and YAML values (`phy.sample_rate=2e5`), in this order
    :raises ConfigError: when the file cannot be read, has no such registry, or an override is malformed
    """
    return settled({"name": path.stem, **read_yaml(path)}, path.parent, overrides)


def settled(values: Mapping[str, Any], directory: Path, overrides: Sequence[str] = ()) -> dict[str, Any]:
    """Settings with their registry found and some of them replaced.

    :param values: in the form of a YAML file
    :param directory: where a relative registry is looked for
    :param overrides: as in :func:`read_settings`
    :raises ConfigError: when there is no such registry, or an override is malformed
    """
    values = dict(values)
    if isinstance(values.get("registry"), str):
        values["registry"] = find_registry(values["registry"], directory)
    for name in _FILES:
        if isinstance(values.get(name), str) and values[name]:
            values[name] = str(directory / Path(values[name]).expanduser())
    if isinstance(values.get("channel"), Mapping):
        values["channel"] = _with_trace(values["channel"], directory)
    if isinstance(values.get("paths"), list):
        values["paths"] = [_with_trace(path, directory) for path in values["paths"]]
    for override in overrides:
        keys, value = parse_override(override)
        if keys == ("registry",):
            value = find_registry(str(value), Path())
        _replace(values, keys, value, override)
    return values


def _with_trace(channel: Any, directory: Path) -> Any:
    """The settings of a channel with the file of its trace seen from a directory."""
    if not isinstance(channel, Mapping) or not isinstance(channel.get("trace"), str) or not channel["trace"]:
        return channel
    return {**channel, "trace": str(directory / Path(channel["trace"]).expanduser())}


def find_registry(name: str, directory: Path) -> str:
    """The absolute path of a registry: a file seen from a directory, or else a built-in one, with or without `.csv`.

    '' stands for no registry, and stays.

    :raises ConfigError: when there is neither
    """
    if not name:
        return name
    path = Path(name).expanduser()
    for candidate in (directory / path, REGISTRY_DIR / path, REGISTRY_DIR / f"{name}.csv"):
        if candidate.is_file():
            return str(candidate.resolve())
    known = ", ".join(sorted(path.stem for path in REGISTRY_DIR.glob("*.csv")))
    raise ConfigError(f"registry = {name!r}: no such file; built in are {known}")


def portable_registry(path: str) -> str:
    """How a file anywhere names a registry: a built-in one by its name, another by its absolute path; '' is none."""
    if not path:
        return path
    found = Path(path).resolve()
    return found.stem if found.parent == REGISTRY_DIR else str(found)


def parse_override(text: str) -> tuple[tuple[str, ...], Any]:
    """`phy.sample_rate=2e5` as (("phy", "sample_rate"), 200000.0).

    :raises ConfigError: when it has no `=`, an empty key, or a value that is not YAML
    """
    key, equals, value = text.partition("=")
    keys = tuple(part.strip() for part in key.split("."))
    if not equals or not all(keys):
        raise ConfigError(f"--set {text}: write key=value, with dots between nested keys")
    value = value.strip()
    if _NUMBER.fullmatch(value):  # YAML 1.1 takes 2e5 for a string
        return keys, float(value)
    parsed = parse_yaml(value, f"--set {text}", "the value is ") if value else ""
    # Without braces the user did not mean a mapping: the colon belongs to a text such as bag:PATH.
    return keys, value if isinstance(parsed, dict) and not value.startswith("{") else parsed


def _replace(values: dict[str, Any], keys: tuple[str, ...], value: Any, override: str) -> None:
    if keys[0] == "topics" and keys[1:]:  # options of one topic beside what is sent anyway
        values["topics"] = topics_of(values.get("topics", AUTO))
    if keys[0] == "robots" and keys[1:] and isinstance(values.get("robots"), int):
        values["robots"] = [{} for _ in range(values["robots"])]
    inner: Any = values
    for depth, key in enumerate(keys[:-1], start=1):
        place: Any = int(key) if isinstance(inner, list) and key.isdecimal() and int(key) < len(inner) else key
        below = None if isinstance(inner, list) and place is key else inner[place] if place in _places(inner) else {}
        if not isinstance(below, Mapping | list):
            raise ConfigError(f"--set {override}: {'.'.join(keys[:depth])} has no settings below it")
        inner[place] = below = list(below) if isinstance(below, list) else dict(below)
        inner = below
    if isinstance(inner, list):
        raise ConfigError(f"--set {override}: {'.'.join(keys[:-1])} is a list; name a setting of one, from 0 on")
    inner[keys[-1]] = value


def _places(values: dict[str, Any] | list[Any]) -> Iterable[Any]:
    return range(len(values)) if isinstance(values, list) else values
