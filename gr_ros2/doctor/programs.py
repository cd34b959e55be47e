"""Programs that a check asks: found on PATH, with a limit on their time.

Invariant: nothing here waits for longer than the limit, and a program that hangs is ended.
"""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Sequence

PATIENCE_S = 20.0
"""s for a program that looks for devices on every bus."""


def output_of(command: Sequence[str]) -> str | None:
    """What a program prints, both streams; None where there is no such program.

    :raises TimeoutError: it has not ended in time
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
