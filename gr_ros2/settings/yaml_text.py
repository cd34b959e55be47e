"""YAML as this program reads and writes it: plain values, and every key once.

Invariant: all YAML, from a file or the command line, is read here. A duplicate key in one mapping is an error: YAML 1.2
(section 3.2.1.3) forbids it, and PyYAML would silently use the last one.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import yaml

from gr_ros2.core.errors import ConfigError
from gr_ros2.settings.yaml_bounds import check_bounds


class _Loader(yaml.SafeLoader):
    """Checks keys as they are written: a key that ``<<`` merges in and the mapping overrides is not a duplicate."""

    def compose_mapping_node(self, anchor: Any) -> Any:
        node = super().compose_mapping_node(anchor)
        first: dict[tuple[str, str], Any] = {}
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode):
                before = first.setdefault((key.tag, key.value), key)
                if before is not key:
                    lines = f"line {before.start_mark.line + 1} and line {key.start_mark.line + 1}"
                    raise ConfigError(f"key {key.value!r} stands twice, in {lines}; keep one")
        return node


def parse_yaml(text: str, where: str, what: str = "") -> Any:
    """The value of a YAML text.

    :param where: what errors begin with, for instance the file name
    :param what: the part of ``where`` that errors name, '' for all of it
    :raises ConfigError: when it is not YAML, exceeds the limits of :mod:`gr_ros2.settings.yaml_bounds`,
        or has a key twice; names the key and its lines
    """
    try:
        check_bounds(text)
        return yaml.load(text, _Loader)
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from error
    except yaml.YAMLError as error:
        raise ConfigError(f"{where}: {what}no YAML ({' '.join(str(error).split())})") from error


def yaml_text(values: Mapping[str, Any]) -> str:
    """A mapping as YAML that :func:`parse_yaml` reads back as it is; keys stay in their order."""
    return yaml.safe_dump(dict(values), sort_keys=False, default_flow_style=None, allow_unicode=True, width=120)
