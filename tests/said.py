"""How a program that a test starts tells the test something: whole lines, from any of its threads."""

from __future__ import annotations

import sys
import threading

_one_at_a_time = threading.Lock()


def say(*words: object) -> None:
    """One line. ``print`` writes its text and the end of the line one after the other, and another thread's between."""
    with _one_at_a_time:
        sys.stdout.write(" ".join(map(str, words)) + "\n")
        sys.stdout.flush()
