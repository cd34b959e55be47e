"""Every fate of the ledger is known wherever fates are shown."""

from __future__ import annotations

import ast
from collections import Counter
from pathlib import Path

import pytest

import gr_ros2
from gr_ros2.core.errors import CodecError
from gr_ros2.link.fates import FATES, Fate, fate_order

ROOT = Path(gr_ros2.__file__).parent
ENDS = {"source", "sink", "link"}


@pytest.mark.parametrize("fate", Fate)
def test_a_fate_is_its_name(fate: Fate) -> None:
    assert FATES[fate] is FATES[str(fate)] is fate
    assert f"{fate}" == fate.value == fate
    assert fate.end in ENDS
    assert fate.words
    assert Counter([fate])[fate.value] == 1


def test_no_two_fates_look_alike() -> None:
    assert len({fate.colour for fate in Fate}) == len({fate.words for fate in Fate}) == len(Fate)


def test_the_documentation_has_every_fate_and_no_other() -> None:
    page = (ROOT.parent / "docs" / "explanation" / "measurements.md").read_text("utf-8")
    table = [line.strip("| ").split(" | ") for line in page.splitlines() if line.startswith("| `")]
    shown = {cells[0].strip("`"): tuple(cells[1:]) for cells in table if len(cells) == 3 and cells[1] in ENDS}
    assert shown == {fate.value: (fate.end, fate.words) for fate in Fate}


def test_what_a_codec_cannot_decode_ends_in_a_fate() -> None:
    ends = {kind.__name__: FATES[kind.fate].value for kind in [CodecError, *CodecError.__subclasses__()]}
    assert ends == {
        "CodecError": "unsupported",
        "UnknownDictionaryError": "unknown_dictionary",
        "DamagedError": "damaged",
        "MissingFrameError": "damaged",
        "UnfitError": "unsupported",
    }


def test_fates_are_not_written_out_where_they_are_meant() -> None:
    """``Lost``, ``Refused`` and ``Dropped`` are made with a Fate, so that none can be misspelt."""
    made = 0
    for path in ROOT.parent.glob("gr_ros2*/*/*.py"):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in MADE_WITH_A_FATE:
                assert not {arg.value for arg in node.args if isinstance(arg, ast.Constant)} & set(Fate), path
                made += 1
    assert made


def test_a_fate_keeps_its_place() -> None:
    assert fate_order([{"in_flight": 1, "b": 1, "none": 0}, {"delivered": 1, "a": 1}]) == [
        *("delivered", "a", "b", "in_flight"),
    ]


MADE_WITH_A_FATE = {"Lost", "Refused", "Dropped"}
