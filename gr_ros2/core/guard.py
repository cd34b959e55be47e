"""Calls something that may fail without harm to its caller: an observer of a link, or one part of a program.

Invariants: the guarded object is called until its first exception; then it is ended, one log line names it, and every
further call is counted as missed; the caller never sees an exception. Any thread may call.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from threading import Lock

from gr_ros2.core.errors import GrRos2Error, RunError

_log = logging.getLogger(__name__)


class Guard:
    """Calls one observer, or one function of it, until it raises.

    :param name: first words of the log line about it
    :param needed: :meth:`check` raises its error, and nothing is logged
    """

    def __init__(self, name: str, *, needed: bool = False) -> None:
        self.name = name
        self.error: Exception | None = None
        """The exception that ended it."""
        self.missed = 0
        """Events that it did not receive, or whose processing failed."""
        self._needed = needed
        self._lock = Lock()

    def __call__(self, call: Callable[..., object], *arguments: object) -> None:
        """Call it, unless it has ended."""
        if self.error is None:
            try:
                call(*arguments)
                return
            except Exception as error:  # noqa: BLE001 - whatever an observer raises, the link goes on
                self.end(error)
        self.miss()

    def last(self, call: Callable[..., object], *arguments: object) -> None:
        """Call it even if it has ended, so that it can release its resources."""
        try:
            call(*arguments)
        except Exception as error:  # noqa: BLE001 - as above
            self.end(error)

    def end(self, error: Exception) -> None:
        """Note that it has failed; only the first error is kept."""
        with self._lock:
            if self.error is not None:
                return
            self.error = error
        if not self._needed:
            _log.error("%s: ended (%s); the link goes on without it", self.name, one_line(error))
            _log.debug("%s", self.name, exc_info=error)

    def miss(self, count: int = 1) -> None:
        """Count events that did not reach it."""
        with self._lock:
            behind = self.error is None and not self.missed
            self.missed += count
        if behind and count:
            _log.warning("%s: slower than the link; what it cannot take is left out", self.name)

    def check(self) -> None:
        """:raises GrRos2Error: if it has failed: its own error, or a RunError that names it"""
        if isinstance(self.error, GrRos2Error):
            raise self.error
        if self.error is not None:
            raise RunError(f"{self.name}: failed ({one_line(self.error)})") from self.error

    def incomplete(self) -> list[str]:
        """What it missed and why, as one line; an empty list where it received everything."""
        if self.error is None and not self.missed:
            return []
        why = "slower than the link" if self.error is None else f"ended ({one_line(self.error)})"
        return [f"{self.name}: {why}; {self.missed} events missed"]


def one_line(error: Exception) -> str:
    """An error in one line, with its class name where the text alone would not say what went wrong."""
    text = " ".join(str(error).split())
    if isinstance(error, OSError) and error.strerror:
        return error.strerror if error.filename is None else f"{error.filename}: {error.strerror}"
    return text if isinstance(error, GrRos2Error) else f"{type(error).__name__}: {text}".rstrip(": ")
