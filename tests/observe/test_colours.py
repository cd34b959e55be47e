"""Colours that tell topics, runs and ledger fates apart."""

from __future__ import annotations

from gr_ros2.link.fates import Fate
from gr_ros2.observe.colours import COLOURS, fate_colour, ink_on


def test_no_two_fates_and_no_two_topics_look_alike() -> None:
    assert len({fate_colour(fate) for fate in Fate}) == len(Fate)
    assert len(set(COLOURS)) == len(COLOURS)


def test_a_fate_of_another_version_has_a_colour_too() -> None:
    assert fate_colour("never heard of") == "#882255"


def test_words_on_a_colour_can_be_read() -> None:
    assert [ink_on(colour) for colour in ("#ffffff", "#2a9d5c", "#332288", "#000000")] == [
        *("#000000", "#000000", "#ffffff", "#ffffff"),
    ]
