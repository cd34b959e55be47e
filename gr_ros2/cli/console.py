"""Where the commands print their tables."""

from __future__ import annotations

from rich.console import Console

PLAIN_WIDTH = 110
"""Columns of the tables where the output is no terminal."""
LOG_S = 10.0
"""Between two lines that say how far something is, where the output is no terminal and lines stay."""


def console() -> Console:
    """Standard output, wide enough for the tables where it is a file or a pipe."""
    made = Console(highlight=False)
    return made if made.is_terminal else Console(highlight=False, width=PLAIN_WIDTH)
