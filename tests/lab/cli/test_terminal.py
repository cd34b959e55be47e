"""The path picture in the terminal."""

from __future__ import annotations

import numpy as np

from gr_ros2_lab.cli.terminal import HEIGHT, path_text


def test_both_paths_are_drawn_with_title_and_axes() -> None:
    sent = [(0.0, 0.0), (1.0, 2.0), (3.0, 2.0)]
    text = path_text(np.array(sent), np.array(sent[:1]), "sent and received")
    assert "sent and received" in text
    assert "2.0" in text
    assert len(text.splitlines()) == HEIGHT
    assert sum(0x2800 < ord(letter) < 0x2900 for letter in text) >= 3


def test_a_path_that_never_arrived_leaves_the_other() -> None:
    text = path_text([(0.0, 0.0), (1.0, 1.0)], [], "title")
    assert sum(0x2800 < ord(letter) < 0x2900 for letter in text) == 2
