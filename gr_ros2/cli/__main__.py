"""The program: what `gr-ros2` and `python -m gr_ros2.cli` start.

Invariant: from the first line of `main` on, Ctrl-C and SIGTERM end the program with one line and one status, whatever
is being loaded; nothing heavy is imported before that.
"""

from __future__ import annotations

import os

from gr_ros2.cli.ending import INTERRUPTED, on_signals


def main() -> None:
    """Entry point of the program; always ends in SystemExit."""
    on_signals(_leave)
    from gr_ros2.cli.main import run

    try:
        status = run()
    finally:
        # Nothing is open any more: whoever cannot wait for the interpreter's own end need not.
        on_signals(_leave)
    raise SystemExit(status)


def _leave(*_: object) -> None:
    """End at once: an exception would come out in the middle of an import, where it passes for something else."""
    os.write(2, b"gr-ros2: interrupted\n")
    os._exit(INTERRUPTED)


if __name__ == "__main__":
    main()
