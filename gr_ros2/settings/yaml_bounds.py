"""Limits of a YAML text, checked before it is loaded: its length, its depth, and the size with its aliases expanded.

Invariant: time and memory are bounded by the text's length, whatever it contains; every text of that length passes if
it has no aliases and is not deeper than a settings file needs.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import yaml

from gr_ros2.core.errors import ConfigError

MOST_CHARACTERS = 1 << 18
MOST_LEVELS = 50
"""Nesting depth; a scenario's settings use five levels."""
MOST_VALUES = 20_000
"""Most values, with every alias expanded."""


@dataclass
class _OpenCollection:
    """A list or mapping whose end has not been read yet. ``values`` counts the values in it, itself included."""

    anchor: str | None
    values: int = 1


def read_bounded(path: Path) -> str:
    """The text of a file. At most the allowed number of characters is read.

    :raises ConfigError: when it is longer
    :raises OSError: when it cannot be read
    :raises UnicodeDecodeError: when it is not UTF-8
    """
    with path.open(encoding="utf-8") as file:
        text = file.read(MOST_CHARACTERS + 1)
    if len(text) > MOST_CHARACTERS:
        raise ConfigError(f"{path}: longer than {MOST_CHARACTERS:,} characters; a file of settings is not")
    return text


def check_bounds(text: str) -> None:
    """Refuse a text that would take too much time or memory to load.

    :raises ConfigError: for a text that is too long, too deep, or whose aliases expand to too much
    :raises yaml.YAMLError: when it is not YAML
    """
    if len(text) > MOST_CHARACTERS:
        raise ConfigError(f"longer than {MOST_CHARACTERS:,} characters; settings are not")
    sizes: dict[str, int] = {}
    levels = [_OpenCollection(None)]
    for event in yaml.parse(text):  # the parser gives one event at a time and builds nothing
        line = 0 if event.start_mark is None else event.start_mark.line + 1
        if isinstance(event, yaml.CollectionStartEvent):
            levels.append(_OpenCollection(event.anchor))
            if len(levels) > MOST_LEVELS:
                raise ConfigError(f"line {line}: more than {MOST_LEVELS} levels one within the other")
            continue
        if isinstance(event, yaml.CollectionEndEvent):
            closed = levels.pop()
            anchor, values = closed.anchor, closed.values
        elif isinstance(event, yaml.ScalarEvent):
            anchor, values = event.anchor, 1
        elif isinstance(event, yaml.AliasEvent):
            if any(level.anchor == event.anchor for level in levels):
                raise ConfigError(f"line {line}: *{event.anchor} stands within &{event.anchor} itself")
            anchor, values = None, sizes.get(str(event.anchor), 1)
        else:
            continue
        if anchor is not None:
            sizes[anchor] = values
        levels[-1].values += values
        if levels[-1].values > MOST_VALUES:
            raise ConfigError(f"line {line}: more than {MOST_VALUES:,} values with every alias written out")
