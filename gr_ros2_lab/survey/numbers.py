"""Reads CSV files of numbers with a header, and says in one line what is wrong with one.

Invariant: a number is finite; an empty cell is one only where the caller allows it, and is NaN then.
"""

from __future__ import annotations

import csv
from collections.abc import Collection, Mapping
from io import StringIO
from itertools import islice
from math import isfinite, nan
from pathlib import Path

import numpy as np

from gr_ros2.core.arrays import Floats
from gr_ros2.core.errors import ConfigError, reason

MOST_BYTES = 64_000_000
"""Of a file: a day of a hundred rows in a second."""


def text_of(path: Path) -> str:
    """The contents of a file.

    :raises ConfigError: when it cannot be read, or is too long
    """
    try:
        if path.stat().st_size > MOST_BYTES:
            raise ConfigError(f"{path}: has more than {MOST_BYTES:,} bytes; cut it")
        return path.read_text("utf-8-sig")  # as spreadsheets write it
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read ({reason(error)})") from error


def read_numbers(path: Path, wanted: Collection[str], may_lack: Collection[str] = ()) -> Mapping[str, Floats]:
    """The columns of a file that are wanted and that it has, each of shape (rows,). Others are not looked at.

    :param may_lack: columns that may have empty cells
    :raises ConfigError: when it cannot be read, or a cell is no finite number; names line, column and value
    """
    rows = csv.reader(StringIO(text_of(path), newline=""))
    try:
        header = [name.strip() for name in next(rows, [])]
        places = {name: header.index(name) for name in wanted if name in header}
        found: dict[str, list[float]] = {name: [] for name in places}
        for row in rows:
            if not row:
                continue
            for name, place in places.items():
                cell = row[place].strip() if place < len(row) else ""
                found[name].append(_number(cell, f"{path}: line {rows.line_num}: {name}", empty=name in may_lack))
    except csv.Error as error:
        raise ConfigError(f"{path}: line {rows.line_num}: {error}") from error
    return {name: np.array(column) for name, column in found.items()}


def check_ranges(path: Path, columns: Mapping[str, Floats], ranges: Mapping[str, tuple[float, float]]) -> None:
    """Check each column that has a range; empty cells pass.

    :raises ConfigError: for a value outside; names line, column and value
    """
    for name in ranges.keys() & columns.keys():
        low, high = ranges[name]
        for row in np.flatnonzero((columns[name] < low) | (columns[name] > high))[:1]:
            value = columns[name][row]
            raise ConfigError(f"{path}: line {line_of(path, row)}: {name} = {value:g}: not within {low:g}..{high:g}")


def line_of(path: Path, row: int) -> int:
    """The line of a file at which a row of :func:`read_numbers` ends.

    :param row: from 0
    """
    rows = csv.reader(StringIO(text_of(path), newline=""))
    next(rows)
    for _ in islice(filter(None, rows), row + 1):
        pass
    return rows.line_num


def _number(cell: str, where: str, *, empty: bool) -> float:
    if not cell and empty:
        return nan
    try:
        value = float(cell)
    except ValueError:
        value = nan
    if not isfinite(value):
        raise ConfigError(f"{where} = {cell!r}: write a finite number, or take the row out")
    return value
