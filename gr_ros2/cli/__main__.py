"""The entry point of `gr-ros2` and of `python -m gr_ros2.cli`.

Invariant: from the first line of `main` on, Ctrl-C and SIGTERM end the program with one line and one exit status, also
during an import. No large package is imported before that.
"""

from __future__ import annotations

import os

from gr_ros2.cli.ending import INTERRUPTED, on_signals


def main() -> None:
    """Entry point of the program; always ends in SystemExit."""
    on_signals(_leave)
    # No plug-in of pydantic is of use here, and to look for one takes a thirtieth of the start of a link.
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")
    from gr_ros2.cli.main import run

    try:
        status = run()
    finally:
        # Nothing is open any more, so a signal may end the program before the interpreter has finished.
        on_signals(_leave)
    raise SystemExit(status)


def _leave(*_: object) -> None:
    """End at once. An exception in the middle of an import would look like another error."""
    os.write(2, b"gr-ros2: interrupted\n")
    os._exit(INTERRUPTED)


if __name__ == "__main__":
    main()
