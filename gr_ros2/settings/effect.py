"""Refuses settings that have no effect where they are given.

Invariant: a default is never refused, and neither is a value that equals it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, is_dataclass
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


def refuse_without_effect(config: Any) -> None:
    """Refuse settings that have no effect beside others. At their defaults they are taken.

    :param config: an object of a settings class
    :raises ValueError: naming setting, value and remedy
    """
    for condition in conditions_of(type(config)):
        if not condition.holds(config):
            refuse_given(config, condition.settings, condition.otherwise)


def refuse_given(config: Any, settings: Iterable[str], why: str, where: str = "") -> None:
    """Refuse some settings of an object unless they are at their defaults.

    :param settings: dotted names, see :class:`ActsWhere`
    :param why: why, and the remedy
    :param where: what the names begin with in the error
    :raises ValueError: naming setting, value and remedy
    """
    for name in settings:
        for given, value in _given(config, name):
            names = isinstance(value, Mapping) and all(map(is_dataclass, value.values()))
            raise ValueError(f"{where}{given} = {', '.join(value) if names else repr(value)}: {why}")


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
