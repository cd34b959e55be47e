"""One number of the benchmark against its target, and all of them as a table.

Invariant: a row without a target is for information and cannot be missed.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Literal

from rich import box
from rich.table import Table

Sense = Literal["≥", "≤", "="] | None
"""Of a value to its target; None: it has none."""
_COMPARE = {"≥": operator.ge, "≤": operator.le, "=": operator.eq}


@dataclass(frozen=True)
class Row:
    """:param form: how numbers are written, for instance ``{:,.0f}``"""

    what: str
    value: float
    unit: str = ""
    sense: Sense = None
    target: float = 0.0
    form: str = "{:,.0f}"
    note: str = ""

    @property
    def met(self) -> bool:
        return self.sense is None or bool(_COMPARE[self.sense](self.value, self.target))

    @property
    def verdict(self) -> str:
        if self.sense is None:
            return ""
        return "ok" if self.met else "MISSED"


def median_of(repeats: int, measure: Callable[[], float]) -> float:
    return median(measure() for _ in range(repeats))


def table(rows: Sequence[Row]) -> Table:
    made = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    made.add_column("Benchmark")
    for heading in ("Target", "Value"):
        made.add_column(heading, justify="right", no_wrap=True)
    made.add_column("")
    made.add_column("Note")
    for row in rows:
        target = f"{row.sense} {row.form.format(row.target)} {row.unit}" if row.sense else ""
        style = None if row.met else "bold red"
        made.add_row(
            row.what,
            target.strip(),
            f"{row.form.format(row.value)} {row.unit}".strip(),
            row.verdict,
            row.note,
            style=style,
        )
    return made
