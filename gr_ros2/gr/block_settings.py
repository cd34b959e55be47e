"""The settings of a block: from its keyword arguments, and back; and its registry."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any, TypeVar

from gr_ros2.core.errors import ConfigError
from gr_ros2.middleware import Middleware
from gr_ros2.settings.config import SinkConfig, SourceConfig, build
from gr_ros2.settings.registry import Registry

_T = TypeVar("_T")


def settings(
    cls: type[_T], values: Mapping[str, Any], registry: str | Registry, middleware: str | Middleware | None
) -> _T:
    """The configuration of a block from its keyword arguments.

    :raises ConfigError: for a wrong setting; the message names the key, the value and what is allowed
    """
    named = dict(values)
    if isinstance(registry, str):
        named["registry"] = registry
    if middleware is not None:
        named["middleware"] = middleware if isinstance(middleware, str) else middleware.name
    return build(cls, named)


def own_settings(config: SourceConfig | SinkConfig) -> dict[str, Any]:
    """The settings of a block as its keyword arguments, without ``registry`` and ``middleware``."""
    names = {item.name for item in fields(config)} - {"registry", "middleware"}
    return {name: getattr(config, name) for name in names}


def read_registry(registry: str | Registry, *, needed: bool = True) -> Registry:
    """Return a Registry as it is, or read it from a CSV file.

    :param needed: whether a registry is required. A receiver needs none if the senders announce their topics
    :raises ConfigError: when a required registry is missing, or the file is wrong
    """
    if isinstance(registry, Registry):
        return registry
    if not registry and not needed:
        return Registry.empty()
    if not registry:
        raise ConfigError("registry is missing; give the path of a CSV with rows of the form name,type")
    return Registry.from_csv(registry)
