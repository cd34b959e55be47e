"""Dictionaries: knowledge about the messages of some types that both ends have in advance.

A dictionary is one JSON file: words (such as frame names), constants (numbers that covariances are made of), and
for each type the float class of its fields, frequent sets of static values, a zstd dictionary, and the definition
where ROS 2 Humble has none or another one.

Invariants: a dictionary never changes; different content is a different dictionary with a different id. The sets
shipped with gr-ros2 are named by number in the first byte of a message; ``digest`` of each is pinned by a test.
"""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property
from importlib.resources import files
from pathlib import Path
from typing import Any

from gr_ros2.compression.floats import CLASSES, KnownNumbers
from gr_ros2.compression.prepared import Model
from gr_ros2.compression.static_values import Words
from gr_ros2.core.errors import ConfigError, shortened

FORMAT = 1
SHIPPED = (1, 2)
"""Numbers 1..13 of the shipped sets: 1 has the types of ROS 2 Humble, 2 those that are new or another
since, up to Lyrical. A sender uses the last one with a definition that fits the message."""
GENERAL = 1
"""The set whose words and constants serve the types that no set has."""


@dataclass(frozen=True)
class TypeEntry:
    """What is known about one type.

    :param classes: float class letter by path of the field
    :param templates: (sequence lengths, coded static values), most frequent first, at most 15
    :param zstd: a zstd dictionary over its payloads, b'' = none
    :param definition: ``.msg`` text, '' for types as ROS 2 Humble has them
    """

    classes: Mapping[str, str] = field(default_factory=dict)
    templates: Sequence[tuple[tuple[int, ...], int]] = ()
    zstd: bytes = b""
    definition: str = ""


@dataclass(frozen=True)
class Dictionary:
    """The content of one dictionary.

    :param name: for people
    :param number: 1..13
    :param words: strings without terminator, most frequent first
    :param constants: bits of doubles, most frequent first
    """

    name: str
    number: int
    words: Sequence[str]
    constants: Sequence[int]
    types: Mapping[str, TypeEntry]

    @property
    def digest(self) -> str:
        """64 hex digits over everything that coding depends on; the name is not part of it."""
        content = {key: value for key, value in self.as_json().items() if key != "name"}
        return hashlib.sha256(json.dumps(content, sort_keys=True, separators=(",", ":")).encode()).hexdigest()

    def model(self, type_name: str) -> Model:
        """The model for the codec ``fields``; words and constants also apply to types without an entry."""
        entry = self.types.get(type_name, TypeEntry())
        return Model(*self._lists, entry.classes, entry.templates)

    @cached_property
    def _lists(self) -> tuple[Words, KnownNumbers]:
        return Words([word.encode() + b"\0" for word in self.words]), KnownNumbers(self.constants)

    def as_json(self) -> dict[str, Any]:
        """What its file has."""
        return {
            "format": FORMAT,
            "name": self.name,
            "words": list(self.words),
            "constants": [f"{bits:016x}" for bits in self.constants],
            "types": {
                name: {
                    "classes": dict(entry.classes),
                    "templates": [[list(counts), f"{coded:x}"] for counts, coded in entry.templates],
                    "zstd": base64.b64encode(entry.zstd).decode(),
                    "definition": entry.definition,
                }
                for name, entry in sorted(self.types.items())
            },
        }


@cache
def shipped(number: int = GENERAL) -> Dictionary:
    """A shipped set by its number.

    :raises ConfigError: when there is none of that number, or its file is damaged
    """
    if number not in SHIPPED:
        raise ConfigError(f"no shipped dictionaries of number {number}; there are {', '.join(map(str, SHIPPED))}")
    folder = Path(str(files("gr_ros2.compression")))
    return read_dictionary(folder / "dictionaries" / f"shipped-{number}.json", number)


def read_dictionary(file: Path, number: int) -> Dictionary:
    """Read one from its file.

    :raises ConfigError: when the file is missing, damaged or of another format; names it
    """
    try:
        return _parse(json.loads(file.read_text(encoding="utf-8")), number)
    except (OSError, LookupError, TypeError, ValueError, AttributeError, RecursionError) as error:
        why = shortened(f"{type(error).__name__}: {error}")
        raise ConfigError(f"{file}: no dictionary, or damaged ({why}); install gr-ros2 again") from error


def _parse(data: Any, number: int) -> Dictionary:
    if data["format"] != FORMAT:
        raise ValueError(f"it is of format {data['format']!r}")
    types = {
        str(name): TypeEntry(
            {str(path): str(letter) for path, letter in entry["classes"].items()},
            tuple((tuple(map(int, counts)), int(coded, 16)) for counts, coded in entry["templates"]),
            base64.b64decode(entry["zstd"], validate=True),
            str(entry["definition"]),
        )
        for name, entry in data["types"].items()
    }
    unknown = {letter for entry in types.values() for letter in entry.classes.values()} - set(CLASSES)
    if unknown:
        raise ValueError(f"float classes {', '.join(sorted(unknown))} are unknown")
    constants = [int(bits, 16) for bits in data["constants"]]
    if not all(0 <= bits < 1 << 64 for bits in constants):
        raise ValueError("a constant is not of 64 bits")
    return Dictionary(str(data["name"]), number, [str(word) for word in data["words"]], constants, types)
