"""A program in a process of its own that is told lines and says lines."""

from __future__ import annotations

import signal
import subprocess
import threading
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

from tests.programs import ProgramProcess
from tests.waiting import PATIENCE_S


class Spoken:
    """One that leaves at the end of its input.

    :param options: of ``subprocess.Popen``
    :ivar said: lines of its output so far
    """

    def __init__(self, command: Sequence[str], **options: Any) -> None:
        self.said: list[str] = []
        pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True, "bufsize": 1}
        self.process: subprocess.Popen[str] = ProgramProcess(list(command), **pipes, **options)
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.take(line.rstrip("\n"))

    def take(self, line: str) -> None:
        """A line of its output."""
        self.said.append(line)

    def tell(self, *lines: str) -> None:
        """Write lines to its input."""
        assert self.process.stdin is not None
        self.process.stdin.write("".join(f"{line}\n" for line in lines))
        self.process.stdin.flush()

    def end(self, number: int = signal.SIGINT) -> int:
        """Its status after a signal."""
        self.process.send_signal(number)
        self.process.wait(PATIENCE_S)
        self.close()
        return self.process.returncode

    def close(self) -> None:
        """End its input; if it does not leave then, it is ended."""
        assert self.process.stdin is not None and self.process.stdout is not None
        with suppress(BrokenPipeError):
            self.process.stdin.close()
        try:
            self.process.wait(PATIENCE_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        self._reader.join(PATIENCE_S)
        self.process.stdout.close()
