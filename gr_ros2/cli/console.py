"""The console on which the commands print their tables, and words that several of them print."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from rich.console import Console

PLAIN_WIDTH = 110
"""Width of the tables in columns, if the output is not a terminal."""
LOG_S = 10.0
"""s between two lines of progress, if the output is not a terminal."""


def console() -> Console:
    """Standard output, wide enough for the tables if it is a file or a pipe."""
    from rich.console import Console

    made = Console(highlight=False)
    return made if made.is_terminal else Console(highlight=False, width=PLAIN_WIDTH)


class Lines:
    """Standard output that gets lines alone, as they are: of a service, without ``rich``, which is 2 MB of memory."""

    def print(self, line: str, *, soft_wrap: bool = True) -> None:  # noqa: ARG002 - as of rich's console
        """Print a line as it is."""
        click.echo(line)


def lines() -> Console | Lines:
    """Standard output of a program that prints tables on a terminal alone."""
    return console() if sys.stdout.isatty() else Lines()


def airtime_words(account: Mapping[str, Any]) -> str:
    """What a link says about how much it may send; '' where nothing limits it."""
    words = [] if account["transmits"] else ["sending is off"]
    if "spent_s" in account and account["allowed_s"] < account["window_s"]:
        words.append(
            f"sent {account['spent_s']:.3g} of {account['allowed_s']:.3g} s allowed in {account['window_s']:g} s"
        )
        if account["waits_s"] > 1:
            words.append(f"the limit lets the next packet leave in {account['waits_s']:.0f} s")
    if not account.get("stored", True):
        words.append("its airtime account cannot be stored")
    return ", ".join(words)
