"""Colours that tell topics, runs and ledger rows apart."""

from __future__ import annotations

from gr_ros2.link.ledger_rows import LedgerRow
from gr_ros2.report.colours import COLOURS, ink_on, row_colour


def test_no_two_rows_and_no_two_topics_look_alike() -> None:
    assert len({row_colour(row) for row in LedgerRow}) == len(LedgerRow)
    assert len(set(COLOURS)) == len(COLOURS)


def test_a_row_of_another_version_has_a_colour_too() -> None:
    assert row_colour("never heard of") == "#882255"


def test_words_on_a_colour_can_be_read() -> None:
    assert [ink_on(colour) for colour in ("#ffffff", "#2a9d5c", "#332288", "#000000")] == [
        *("#000000", "#000000", "#ffffff", "#ffffff"),
    ]
