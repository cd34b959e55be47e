"""Arguments and options of several commands, which shells can complete."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import fields, is_dataclass
from math import isfinite
from types import MappingProxyType
from typing import Any, get_type_hints

import click
from click.shell_completion import CompletionItem

from gr_ros2.core.backends import BackendTable
from gr_ros2.settings.fields import AUTO

MOST_S = 1e9
"""s that a program can wait at most."""


class Completed(click.ParamType):
    """A parameter whose values the shell can complete."""

    def candidates(self) -> Iterable[CompletionItem]:
        """All values that the shell may offer."""
        raise NotImplementedError

    def shell_complete(
        self,
        ctx: click.Context,  # noqa: ARG002 - click's signature
        param: click.Parameter,  # noqa: ARG002
        incomplete: str,
    ) -> list[CompletionItem]:
        return [item for item in self.candidates() if item.value.startswith(incomplete)]


class Number(click.FloatRange):
    """A finite number in a range: to click alone, NaN is in every one."""

    name = "float"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        number: float = super().convert(value, param, ctx)
        if not isfinite(number):
            self.fail(f"{value!r} is no finite number", param, ctx)
        return number

    def _describe_range(self) -> str:
        return "" if self.min is self.max is None else super()._describe_range()


class OrAuto(click.ParamType):
    """`auto`, or a value of another type."""

    def __init__(self, other: click.ParamType) -> None:
        self._other = other
        self.name = other.name

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        return value if value == AUTO else self._other.convert(value, param, ctx)


class BackendName(Completed):
    """A name in a table of back-ends, or of ``more``. It is checked later, when the back-end is loaded."""

    name = "name"

    def __init__(self, table: BackendTable[Any], more: Mapping[str, Any] = MappingProxyType({})) -> None:
        self._backends = {**table.own, **more}

    def candidates(self) -> Iterable[CompletionItem]:
        return (CompletionItem(name, help=backend.summary) for name, backend in self._backends.items())


class SettingParam(Completed):
    """`KEY=VALUE`. The shell completes the key.

    :param settings: class of the configuration that has the key
    """

    name = "setting"

    def __init__(self, settings: type[Any]) -> None:
        self._settings = settings

    def candidates(self) -> Iterable[CompletionItem]:
        return map(CompletionItem, setting_keys(self._settings))


def setting_keys(settings: type[Any], prefix: str = "") -> Iterator[str]:
    """The keys of a configuration class, with dots between nested keys."""
    kinds = get_type_hints(settings)
    for field in fields(settings):
        if is_dataclass(kinds[field.name]):
            yield from setting_keys(kinds[field.name], f"{prefix}{field.name}.")
        else:
            yield prefix + field.name.removesuffix("_")  # of a name that Python keeps for itself
    for other, but in getattr(settings, "also", {}).items():
        yield from (key for key in setting_keys(other, prefix) if key not in but)


def set_option(settings: type[Any], what: str = "one setting") -> Callable[[Any], Any]:
    """The option `--set` of a command.

    :param settings: class of the configuration it changes
    """
    return click.option(
        "--set",
        "overrides",
        type=SettingParam(settings),
        multiple=True,
        metavar="KEY=VALUE",
        help=f"Change {what}, dots between keys.",
    )
