"""Every setting of a link as one flat list of named values, in the form of ROS parameters.

Invariants: names, meanings and ranges come from the configuration classes and are never written a second time. A value
without a ROS type (complex numbers, mappings) appears as text. This module does not use rclpy.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, is_dataclass
from typing import Any

from gr_ros2.settings.fields import Setting, members, settings_of

Plain = bool | int | float | str | list[str] | None


@dataclass(frozen=True, slots=True)
class Parameter:
    """One setting.

    :param name: dots between nested keys, as in YAML overrides
    :param value: current value; None if it is not set
    :param meaning: one line
    :param minimum: smallest number allowed; None if there is no limit
    :param maximum: largest number allowed; None if there is no limit
    :param rule: what else is allowed, in words
    :param strict: whether only values of exactly this type are allowed
    """

    name: str
    value: Plain
    meaning: str = ""
    minimum: float | None = None
    maximum: float | None = None
    rule: str = ""
    strict: bool = False


def parameters(settings: Any, prefix: str = "") -> Iterator[Parameter]:
    """The settings of a configuration object, in their order. Settings of nested objects follow in place.

    :param prefix: with a dot at its end, or ''
    """
    for setting in settings_of(type(settings)):
        name, value = f"{prefix}{setting.name}", getattr(settings, setting.attribute)
        if is_dataclass(value):
            yield from parameters(value, f"{name}.")
        elif name in ("topics", "offer"):
            yield _parameter(name, list(value), setting)
            for word, options in value.items():
                yield from _set_options(options, f"{name}.{word}.")
        elif isinstance(value, Mapping):
            yield from _entries(value, f"{name}.", setting.meaning)
        else:
            yield _parameter(name, value, setting)


def overrides(values: Mapping[str, Any]) -> list[str]:
    """ROS parameters as `key=value`, in the form that the command line uses."""
    return [f"{name}={_text(value)}" for name, value in values.items()]


def _entries(mapping: Mapping[str, Any], prefix: str, meaning: str) -> Iterator[Parameter]:
    for key, value in mapping.items():
        if is_dataclass(value):
            yield from parameters(value, f"{prefix}{key}.")
        elif isinstance(value, Mapping):
            yield from _entries(value, f"{prefix}{key}.", meaning)
        else:
            yield Parameter(f"{prefix}{key}", _plain(value), meaning)


def _set_options(options: Any, prefix: str) -> Iterator[Parameter]:
    """Options of a topic that are not at their defaults."""
    default = {parameter.name: parameter.value for parameter in parameters(type(options)(), prefix)}
    return (one for one in parameters(options, prefix) if one.value != default[one.name])


def _parameter(name: str, value: Any, setting: Setting) -> Parameter:
    above, below, choices = setting.above, setting.below, ", ".join(map(str, setting.choices))
    rules = [f"{word} {limit:g}" for word, limit in (("above", above), ("below", below)) if limit is not None]
    if choices:
        rules.append(f"or {choices}" if setting.kinds else f"one of {choices}")
    least = above if setting.least is None else setting.least
    most = below if setting.most is None else setting.most
    return Parameter(
        name,
        _plain(value),
        setting.explained,
        None if least is None else float(least),
        None if most is None else float(most),
        "; ".join(rules),
        strict=isinstance(value, bool | int | str) and len(members(setting.hint)) == 1,
    )


def _plain(value: Any) -> Plain:
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, list | tuple):
        return [item if isinstance(item, str) else str(item) for item in value]
    return str(value)


def _text(value: Any) -> str:
    """A value as YAML reads it back; numbers and lists are the same in JSON."""
    return json.dumps(list(value) if isinstance(value, list | tuple) or hasattr(value, "tolist") else value)
