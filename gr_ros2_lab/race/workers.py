"""Processes of the race. A worker is an object in its own process, which may enter a network namespace. Its owner, the
process that started it, calls its methods.

Invariants: a worker ends with the ``with`` block of its owner, or with its owner, whatever ends the owner. Only the
owner reacts to Ctrl-C; it then ends the workers at once. An error in a worker is raised in its owner, with the same
text.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from multiprocessing.connection import Connection
from typing import Any

from gr_ros2.core.errors import GrRos2Error, RunError
from gr_ros2.core.forks import FORKS, load_for_forks
from gr_ros2.core.watch import wait_until
from gr_ros2_lab.race.namespaces import enter

PROCESSOR_S = "processor_s"
"""What to call for the processor time that all threads of a process have used so far, s."""
_START_S = 60.0
_END_S = 10.0
_NEEDED = tuple(f"gr_ros2_lab.race.{part}" for part in ("channel", "endpoints", "links"))
"""Modules that workers are made of."""


class Worker:
    """An object made by ``make(*arguments)`` in another process.

    :param name: for error messages
    :param namespace: path of the network namespace to enter first, '' to stay
    :param make: a class or function of a module that returns a context manager
    :raises RunError: when the object cannot be made
    """

    def __init__(
        self, name: str, namespace: str, make: Callable[..., AbstractContextManager[Any]], *arguments: Any
    ) -> None:
        self._name = name
        load_for_forks(*_NEEDED)
        self._ours, theirs = FORKS.Pipe()
        self._process = FORKS.Process(
            target=_serve, args=(theirs, namespace, make, arguments), name=f"gr-ros2-{name}", daemon=True
        )
        self._process.start()
        theirs.close()
        try:
            self.answer()
        except BaseException:
            self.close(at_once=True)
            raise

    def call(self, method: str, *arguments: Any, timeout_s: float = _START_S) -> Any:
        """Call a method of the object and return its result, or return the value of an attribute.

        :raises RunError: when the call fails, takes longer than ``timeout_s``, or the process has ended
        """
        self.ask(method, *arguments)
        return self.answer(timeout_s)

    def ask(self, method: str, *arguments: Any) -> None:
        """Begin a call. Its :meth:`answer` has to be taken before the next call.

        :raises RunError: when the process has ended
        """
        try:
            self._ours.send((method, arguments))
        except OSError as error:
            raise RunError(f"the race's {self._name} has ended before its time") from error

    def answer(self, timeout_s: float = _START_S) -> Any:
        """Wait for the result of the call that was begun.

        :raises RunError: see :meth:`call`
        """
        try:
            if not wait_until(self._ours.poll, timeout_s, self._ours.poll):
                raise RunError(f"the race's {self._name} has not answered for {timeout_s:g} s")
            failed, value = self._ours.recv()
        except (EOFError, ConnectionError) as error:
            raise RunError(f"the race's {self._name} has ended before its time") from error
        if failed:
            raise RunError(f"the race's {self._name}: {value}")
        return value

    def close(self, at_once: bool = False) -> None:
        """Close the connection to the process, so that it ends; if it does not end, kill it. Idempotent.

        :param at_once: kill the process without waiting for its current work
        """
        self._ours.close()
        self._process.join(0 if at_once else _END_S)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()

    def __enter__(self) -> Worker:
        return self

    def __exit__(self, kind: object, *error: object) -> None:
        self.close(at_once=kind is not None)


def _serve(
    line: Connection, namespace: str, make: Callable[..., AbstractContextManager[Any]], arguments: tuple[Any, ...]
) -> None:
    try:
        if namespace:
            enter(namespace)
        with make(*arguments) as served:
            line.send((False, None))
            while True:
                method, arguments = line.recv()
                found = time.process_time if method == PROCESSOR_S else getattr(served, method)
                line.send((False, found(*arguments) if callable(found) else found))
    except (EOFError, ConnectionError):
        return  # the owner has closed the connection, or has ended
    except Exception as error:  # noqa: BLE001 - sent to the owner
        text = str(error) if isinstance(error, GrRos2Error) else f"{type(error).__name__}: {error}"
        line.send((True, text))
