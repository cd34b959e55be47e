"""The console on which the commands print their tables."""

from __future__ import annotations

from rich.console import Console

PLAIN_WIDTH = 110
"""Width of the tables in columns, if the output is not a terminal."""
LOG_S = 10.0
"""s between two lines of progress, if the output is not a terminal."""


def console() -> Console:
    """Standard output, wide enough for the tables if it is a file or a pipe."""
    made = Console(highlight=False)
    return made if made.is_terminal else Console(highlight=False, width=PLAIN_WIDTH)
