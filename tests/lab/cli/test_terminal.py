"""The path picture in the terminal."""

from __future__ import annotations

import re

import numpy as np

from gr_ros2_lab.cli.run import HEIGHT, path_text


def test_both_paths_are_drawn_with_title_and_axes() -> None:
    sent = [(0.0, 0.0), (1.0, 2.0), (3.0, 2.0)]
    text = path_text(np.array(sent), np.array(sent[:1]), "sent and received")
    assert "sent and received" in text
    assert "2.0" in text
    assert len(text.splitlines()) == HEIGHT
    assert sum(0x2800 < ord(letter) < 0x2900 for letter in text) == 2
    assert "x" in text


def test_a_path_that_never_arrived_leaves_the_other() -> None:
    text = path_text([(0.0, 0.0), (1.0, 1.0)], [], "title")
    assert sum(0x2800 < ord(letter) < 0x2900 for letter in text) == 2


def test_one_metre_is_as_long_both_ways() -> None:
    """A square path fills the height, and as many dots across."""
    square = [(x / 10, y) for x in range(11) for y in (0.0, 1.0)] + [(x, y / 10) for y in range(11) for x in (0.0, 1.0)]
    rows = [
        [place for place, letter in enumerate(row) if 0x2800 < ord(letter) < 0x2900]
        for row in re.sub(r"\x1b\[[0-9;]*m", "", path_text(square, [], "square")).splitlines()
    ]
    drawn = [number for number, row in enumerate(rows) if row]
    across = max(max(row) for row in rows if row) - min(min(row) for row in rows if row)
    assert abs(across - 2 * (drawn[-1] - drawn[0])) <= 4  # a letter is twice as high as wide
