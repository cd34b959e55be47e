"""Every row of the ledger is known wherever rows are shown."""

from __future__ import annotations

import ast
from collections import Counter
from pathlib import Path

import pytest

import gr_ros2
from gr_ros2.core.errors import CodecError
from gr_ros2.link.ledger_rows import ROWS, LedgerRow, row_order

ROOT = Path(gr_ros2.__file__).parent
ENDS = {"source", "sink", "link"}


@pytest.mark.parametrize("row", LedgerRow)
def test_a_row_is_its_name(row: LedgerRow) -> None:
    assert ROWS[row] is ROWS[str(row)] is row
    assert f"{row}" == row.value == row
    assert row.end in ENDS
    assert row.words
    assert Counter([row])[row.value] == 1


def test_no_two_rows_look_alike() -> None:
    assert len({row.colour for row in LedgerRow}) == len({row.words for row in LedgerRow}) == len(LedgerRow)


def test_the_documentation_has_every_row_and_no_other() -> None:
    page = (ROOT.parent / "docs" / "explanation" / "measurements.md").read_text("utf-8")
    table = [line.strip("| ").split(" | ") for line in page.splitlines() if line.startswith("| `")]
    shown = {cells[0].strip("`"): tuple(cells[1:]) for cells in table if len(cells) == 3 and cells[1] in ENDS}
    assert shown == {row.value: (row.end, row.words) for row in LedgerRow}


def test_what_a_codec_cannot_decode_ends_in_a_row() -> None:
    kinds = [CodecError, *CodecError.__subclasses__()]
    assert [ROWS[kind.row].value for kind in kinds] == ["unsupported", "unknown_dictionary", "damaged"]


@pytest.mark.parametrize("row", LedgerRow)
def test_rows_are_not_written_out_where_they_are_meant(row: LedgerRow) -> None:
    """``Lost``, ``Refused`` and ``Dropped`` are made with a LedgerRow, so that none can be misspelt."""
    made = 0
    for path in (*(ROOT / "link").glob("*.py"), *(ROOT / "gr").glob("*.py"), *(ROOT / "record").glob("*.py")):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in MADE_WITH_A_ROW:
                assert not [arg for arg in node.args if isinstance(arg, ast.Constant) and arg.value == row.value], path
                made += 1
    assert made


def test_a_row_keeps_its_place() -> None:
    assert row_order([{"in_flight": 1, "b": 1, "none": 0}, {"delivered": 1, "a": 1}]) == [
        *("delivered", "a", "b", "in_flight"),
    ]


MADE_WITH_A_ROW = {"Lost", "Refused", "Dropped"}
