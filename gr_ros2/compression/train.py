"""Dictionaries learned from messages.

Invariant: deterministic: the same messages in the same order give the same dictionary, byte for byte.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, TypeVar

from gr_ros2.compression.ans import Table
from gr_ros2.compression.dictionary import OWN, Dictionary, TypeEntry
from gr_ros2.compression.fields import FieldsCodec
from gr_ros2.compression.floats import (
    CLASSES,
    DEFAULT_CLASS,
    KnownNumbers,
    class_table,
    push_double,
    push_quaternion,
    push_single,
)
from gr_ros2.compression.layout import DOUBLE, LONG_TEXT, MATRIX, QUATERNION, SINGLE, STRING, Layout
from gr_ros2.compression.prepared import Model
from gr_ros2.compression.schema import BIG, Composite, Types
from gr_ros2.compression.static_values import Words, numbered
from gr_ros2.compression.zstd_frames import Zstd, train

_T = TypeVar("_T")

MAX_SAMPLES = 1000
"""Most messages of a type that are analysed, evenly spread."""
MAX_WORDS, MAX_CONSTANTS, MAX_TEMPLATES = 1000, 250, 15
_COMMON = 0.02
"""A constant or a set of static values enters the dictionary if at least this share of a type's messages has it."""
_VALUES_PER_CLASS = 150


def learn(
    messages: Iterable[tuple[str, bytes]],
    name: str,
    *,
    number: int = OWN,
    base: Dictionary | None = None,
    definitions: Mapping[str, str] | None = None,
    zstd_size: int = 4096,
) -> Dictionary:
    """A dictionary from sample messages.

    :param messages: (type name, payload)
    :param base: its words and constants follow after the learned ones
    :param definitions: ``.msg`` texts of types; kept in the dictionary where ROS 2 Humble has none or another one
    :param zstd_size: bytes of each type's zstd dictionary at most; 0 = none
    """
    types = Types(definitions)
    by_type: dict[str, list[bytes]] = defaultdict(list)
    for type_name, payload in messages:
        by_type[type_name].append(payload)
    for type_name, payloads in by_type.items():
        step = max(1, -(-len(payloads) // MAX_SAMPLES))
        by_type[type_name] = payloads[::step]
    seen = {type_name: _Seen(types.tree(type_name), payloads) for type_name, payloads in sorted(by_type.items())}
    words = _ranked([item.words for item in seen.values()], base.words if base else (), MAX_WORDS)
    constants = _ranked([item.constants for item in seen.values()], base.constants if base else (), MAX_CONSTANTS)
    model = Model(Words([word.encode() + b"\0" for word in words]), KnownNumbers(constants), {})
    entries = {
        type_name: TypeEntry(
            item.classes(model.constants),
            item.templates(model),
            _zstd_dictionary(item.normalised, zstd_size),
            types.definitions.get(type_name, ""),
        )
        for type_name, item in seen.items()
    }
    return Dictionary(name, number, words, constants, entries)


class _Seen:
    """Statistics of the samples of one type."""

    def __init__(self, tree: Composite | None, payloads: Sequence[bytes]) -> None:
        self._tree = tree
        self._payloads = payloads
        self.words: Counter[str] = Counter()
        self.constants: Counter[int] = Counter()
        self.normalised = list(payloads)
        self._samples: dict[str, tuple[int, list[Any]]] = {}
        codec = _codec(tree, Model(Words(()), KnownNumbers(()), {}))
        for n, payload in enumerate(payloads):
            found = codec.layout(payload) if codec is not None else None
            if found is not None:
                self.normalised[n] = found[0].normalised(payload)
                self._look(found[0], payload)
        weight = max(1, len(payloads))
        self.words = Counter({word: count * 1000 // weight for word, count in self.words.items()})
        self.constants = Counter(
            {bits: count * 1000 // weight for bits, count in self.constants.items() if count > _COMMON * weight}
        )

    def _look(self, layout: Layout, payload: bytes) -> None:
        values, reals = layout.unpack(payload), layout.unpack_reals(payload)
        little = layout.shape.order != BIG
        constants: set[int] = set()
        for slot in layout.outline.static_values:
            value = values[slot.index]
            if slot.kind == STRING and 0 < len(value) <= LONG_TEXT and value[-1] == 0:
                if numbered(value):
                    continue  # the codec composes names of numbered robots itself
                try:
                    self.words[value[:-1].decode()] += 1
                except UnicodeDecodeError:
                    continue
            elif slot.kind == MATRIX and little:
                constants |= {int.from_bytes(value[at : at + 8], "little") for at in range(0, len(value), 8)}
        for slot in layout.outline.live:
            if slot.kind not in (DOUBLE, SINGLE, QUATERNION):
                continue
            span = 4 if slot.kind == QUATERNION else 1
            numbers = values[slot.index : slot.index + span]
            self._samples.setdefault(slot.path, (slot.kind, []))[1].append(
                (numbers, reals[slot.real : slot.real + span])
            )
            if slot.kind != SINGLE:
                constants |= set(numbers)
        for bits in constants - {0}:
            self.constants[bits] += 1

    def classes(self, constants: KnownNumbers) -> dict[str, str]:
        """The letter of each field for which the default class is not the best."""
        found: dict[str, str] = {}
        for path, (kind, samples) in self._samples.items():
            costs = {letter: _bits(kind, samples, class_table(letter), constants) for letter in CLASSES}
            found[path] = min(costs, key=lambda letter: (costs[letter], letter))
        return {path: letter for path, letter in sorted(found.items()) if letter != DEFAULT_CLASS}

    def templates(self, model: Model) -> tuple[tuple[tuple[int, ...], int], ...]:
        """The most frequent sets of static values."""
        codec = _codec(self._tree, model)
        if codec is None:
            return ()
        counts = Counter(found for payload in self._payloads if (found := codec.static_values(payload)) is not None)
        common = [item for item, count in counts.most_common(MAX_TEMPLATES) if count > _COMMON * len(self._payloads)]
        return tuple(common)


def _codec(tree: Composite | None, model: Model) -> FieldsCodec | None:
    return None if tree is None else FieldsCodec(tree, model, Zstd())


def _bits(kind: int, samples: Sequence[Any], table: Table, constants: KnownNumbers) -> int:
    """Cost of the numbers of a field with a class, bits."""
    x = 1
    for bits, reals in samples[:: max(1, len(samples) // _VALUES_PER_CLASS)]:
        if kind == QUATERNION:
            x = push_quaternion(x, bits, reals, table, constants)
        elif kind == DOUBLE:
            x = push_double(x, bits[0], reals[0], table, constants)
        else:
            x = push_single(x, bits[0], reals[0], table)
    return x.bit_length()


def _ranked(counted: Sequence[Counter[_T]], base: Sequence[_T], limit: int) -> list[_T]:
    """Values in order of frequency over the types, then the rest of ``base``."""
    total: Counter[_T] = Counter()
    for counter in counted:
        total.update(counter)
    learned = sorted(total, key=lambda item: (-total[item], str(item)))[: limit - min(limit // 2, len(base))]
    known = set(learned)
    return (learned + [item for item in base if item not in known])[:limit]


def _zstd_dictionary(samples: list[bytes], size: int) -> bytes:
    """A trained dictionary; where the samples are too few or too small for training, the samples themselves."""
    if not size:
        return b""
    try:
        return train(samples, size)
    except ValueError:
        distinct = list(dict.fromkeys(samples))
        out = b""
        for sample in distinct:
            if len(out) + len(sample) > size:
                break
            out = sample + out
        return out if len(out) >= 8 else b""
