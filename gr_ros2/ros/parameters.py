"""Every setting of a link as one flat list of named values, as ROS parameters have them.

Invariants: names, meanings and ranges are those of the configuration classes, never written a second time; a value that
ROS has no type for (complex numbers, mappings) appears as text; nothing here knows rclpy.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

from annotated_types import Ge, Gt, Le, Lt

from gr_ros2.config import meanings

Plain = bool | int | float | str | list[str] | None


@dataclass(frozen=True, slots=True)
class Parameter:
    """One setting.

    :param name: dots between nested keys, as in YAML overrides
    :param value: now; None where it is not set
    :param meaning: one line
    :param minimum: smallest number allowed, None without
    :param maximum: largest number allowed, None without
    :param rule: what else is allowed, in words
    :param strict: whether only values of this very type fit
    """

    name: str
    value: Plain
    meaning: str = ""
    minimum: float | None = None
    maximum: float | None = None
    rule: str = ""
    strict: bool = False


def parameters(settings: Any, prefix: str = "") -> Iterator[Parameter]:
    """The settings of a configuration object, in their order, those of nested objects in place.

    :param prefix: with a dot at its end, or ''
    """
    said, hints = meanings(type(settings)), get_type_hints(type(settings), include_extras=True)
    for item in fields(settings):
        name, value = f"{prefix}{item.name}", getattr(settings, item.name)
        if is_dataclass(value):
            yield from parameters(value, f"{name}.")
        elif isinstance(value, Mapping):
            yield from _entries(value, f"{name}.", said.get(item.name, ""))
        else:
            yield _parameter(name, value, said.get(item.name, ""), hints[item.name])


def overrides(values: Mapping[str, Any]) -> list[str]:
    """ROS parameters as `key=value`, the way the command line writes settings."""
    return [f"{name}={_text(value)}" for name, value in values.items()]


def _entries(mapping: Mapping[str, Any], prefix: str, meaning: str) -> Iterator[Parameter]:
    for key, value in mapping.items():
        if is_dataclass(value):
            yield from parameters(value, f"{prefix}{key}.")
        elif isinstance(value, Mapping):
            yield from _entries(value, f"{prefix}{key}.", meaning)
        else:
            yield Parameter(f"{prefix}{key}", _plain(value), meaning)


def _parameter(name: str, value: Any, meaning: str, hint: Any) -> Parameter:
    hints = list(_parts(hint))
    limits = [mark for part in hints if get_origin(part) is Annotated for mark in _limits(get_args(part)[1:])]
    above = [mark.gt for mark in limits if isinstance(mark, Gt)]
    below = [mark.lt for mark in limits if isinstance(mark, Lt)]
    rules = [f"above {limit}" for limit in above] + [f"below {limit}" for limit in below]
    choices = [str(choice) for part in hints if get_origin(part) is Literal for choice in get_args(part)]
    if choices:
        rules.append(f"one of {', '.join(choices)}")
    least = [mark.ge for mark in limits if isinstance(mark, Ge)] + above
    most = [mark.le for mark in limits if isinstance(mark, Le)] + below
    return Parameter(
        name,
        _plain(value),
        meaning,
        float(least[0]) if least else None,  # type: ignore[arg-type]
        float(most[0]) if most else None,  # type: ignore[arg-type]
        "; ".join(rules),
        strict=isinstance(value, bool | int | str) and len(hints) == 1 + (get_origin(hint) is Annotated),
    )


def _parts(hint: Any) -> Iterator[Any]:
    """A type and what it is made of: the members of a union, what is annotated."""
    yield hint
    if get_origin(hint) is Annotated:
        yield from _parts(get_args(hint)[0])
    elif get_origin(hint) in (Union, UnionType):
        for part in get_args(hint):
            yield from _parts(part)


def _limits(marks: Sequence[Any]) -> Iterator[Any]:
    """The bounds among annotations; pydantic's Field carries its own as metadata."""
    for mark in marks:
        yield from getattr(mark, "metadata", [mark])


def _plain(value: Any) -> Plain:
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, list | tuple):
        return [item if isinstance(item, str) else str(item) for item in value]
    return str(value)


def _text(value: Any) -> str:
    """A value as YAML reads it back; numbers and lists are the same in JSON."""
    return json.dumps(list(value) if isinstance(value, list | tuple) or hasattr(value, "tolist") else value)
