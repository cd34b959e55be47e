"""Refuses settings that have no effect where they are given: of another version, of the other end, or beside others.

Invariant: a default is never refused, and neither is a value that equals it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from gr_ros2.settings.fields import settings_of


@dataclass(frozen=True)
class ActsWhere:
    """Settings that act under a condition alone; the attribute ``conditions`` of a settings class has its own.

    :param settings: dotted names, in which ``*`` stands for every entry of a mapping or list
    :param holds: whether they act in an object of that class
    :param otherwise: why they do not, and the remedy, as the error says it
    """

    settings: tuple[str, ...]
    holds: Callable[[Any], bool]
    otherwise: str


def refuse_without_effect(config: Any, version: int | None = None, where: str = "", end: str = "") -> None:
    """Refuse settings that have no effect. At their defaults they are taken.

    :param config: an object of a settings class
    :param version: of the wire format that runs; None: whatever version
    :param where: what the names of the settings begin with in the error
    :param end: ``source`` or ``sink``: the end of the link at which they are given; '': at both, as in a registry
    :raises ValueError: naming setting, value and remedy
    """
    for setting in () if version is None else settings_of(type(config)):
        value = getattr(config, setting.attribute)
        if value == setting.default:
            continue
        if setting.version not in (None, version):
            raise ValueError(f"{where}{setting.name} = {value!r}: version {version} has no such setting; leave it out")
        if end and setting.end not in (None, end):
            raise ValueError(
                f"{where}{setting.name} = {value!r}: acts at the {setting.end} alone; give it to ros_{setting.end}, or "
                "leave it out"
            )
    for condition in conditions_of(type(config)):
        if not condition.holds(config):
            for name in condition.settings:
                for given, value in _given(config, name):
                    raise ValueError(f"{where}{given} = {value!r}: {condition.otherwise}")


def conditions_of(cls: type[Any]) -> list[ActsWhere]:
    """The conditions of a settings class and its bases."""
    return [condition for part in cls.__mro__ for condition in vars(part).get("conditions", ())]


def _given(config: Any, name: str, within: str = "") -> Iterator[tuple[str, Any]]:
    """The settings of a dotted name that are not at their defaults, by their full names."""
    first, _, rest = name.partition(".")
    if first == "*":
        entries = config.items() if isinstance(config, Mapping) else enumerate(config)
        for key, entry in entries:
            yield from _given(entry, rest, f"{within}.{key}." if isinstance(config, Mapping) else f"{within}[{key}].")
    elif rest:
        if (part := getattr(config, first)) is not None:
            yield from _given(part, rest, f"{within}{first}" if rest.startswith("*") else f"{within}{first}.")
    else:
        default = next(setting.default for setting in settings_of(type(config)) if setting.name == first)
        if (value := getattr(config, first)) != default:
            yield f"{within}{first}", value
