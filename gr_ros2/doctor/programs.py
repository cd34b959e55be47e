"""Runs the programs that a check needs. They are found on PATH and have a time limit.

Invariant: no call waits for longer than the limit. A program that hangs is ended.
"""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Sequence

PATIENCE_S = 20.0
"""Time limit of a program, s. Such a program searches every bus for devices."""


def output_of(command: Sequence[str]) -> str | None:
    """What a program prints on both streams; None if the program is not installed.

    :raises TimeoutError: when the program has not ended in time
    """
    program = shutil.which(command[0])
    if program is None:
        return None
    try:
        done = subprocess.run(
            [program, *command[1:]],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            timeout=PATIENCE_S,
            check=False,
        )
    except subprocess.TimeoutExpired as error:
        raise TimeoutError(f"{command[0]} has not ended after {PATIENCE_S:g} s") from error
    return done.stdout.decode("utf-8", "replace")
