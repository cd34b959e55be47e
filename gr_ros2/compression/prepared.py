"""An outline together with the models of a dictionary, ready for use.

Invariant: it depends only on type, sequence lengths and dictionary, so both ends prepare the same.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from gr_ros2.compression.ans import Table
from gr_ros2.compression.floats import DEFAULT_CLASS, KnownNumbers, class_table
from gr_ros2.compression.layout import Outline
from gr_ros2.compression.static_values import Value, Words, pop_static

PARTS = 15
"""Symbol for static values that are none of the type's templates 0..14."""
TEMPLATES = Table([1200, 500, 300, 200, *[60] * 11, 1100])


@dataclass(frozen=True)
class Model:
    """The knowledge of a dictionary about one type.

    :param classes: letter of each field's float class, by path
    :param templates: sets of static values for given sequence lengths, as coded without templates
    """

    words: Words
    constants: KnownNumbers
    classes: Mapping[str, str]
    templates: Sequence[tuple[tuple[int, ...], int]] = ()


class Prepared:
    """An outline with its models and with cached results for its messages."""

    def __init__(self, plan: Outline, model: Model, counts: tuple[int, ...]) -> None:
        self.plan = plan
        self.counts = counts
        self.codable = plan.codable
        self.tables = [class_table(model.classes.get(slot.path, DEFAULT_CLASS)) for slot in plan.live]
        self.backward = list(zip(plan.live, self.tables, strict=True))[::-1]
        self.forward = self.backward[::-1]
        self.bulk = plan.bulk
        self.static_indexes = [slot.index for slot in plan.static_values]
        self.templates: dict[tuple[Value, ...], int] = {}
        self.template_values: dict[int, list[Value]] = {}
        self.blank: list[Any] = [0] * (len(plan.items) + 1)
        for index, count in plan.counts.items():
            self.blank[index] = count
        for number, (of_counts, coded) in enumerate(model.templates[:PARTS]):
            if of_counts == counts:
                rest, values = pop_static(coded, plan.static_values, model.words, model.constants)
                if rest == 0:
                    self.templates.setdefault(tuple(values), number)
                    self.template_values[number] = values
