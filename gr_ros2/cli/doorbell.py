"""How `gr-ros2 dashboard` finds programs of this user that run now, and asks one of them to show itself.

Each program that can be looked at listens on a Unix socket named after its process in a folder only its user may
enter; a visitor sends one line of JSON and gets one line back. Laws: nobody else can ring; a program that is killed
leaves a socket that answers no more and is cleared away by the next visitor; ringing never holds the program up.
"""

from __future__ import annotations

import json
import os
import socket
import tempfile
import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any

from gr_ros2.errors import GrRos2Error, RunError

_LINE = 4096
_WAIT_S = 10.0
"""s a visitor waits for the answer: a dashboard is drawn first."""

Answer = Callable[[Mapping[str, Any]], Mapping[str, Any]]


def folder() -> Path:
    """Where this user's sockets are; made if missing.

    :raises RunError: when somebody else owns it
    """
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    base = Path(runtime) if runtime and Path(runtime).is_dir() else Path(tempfile.gettempdir())
    path = base / f"gr-ros2-{os.getuid()}"
    path.mkdir(mode=0o700, exist_ok=True)
    if path.stat().st_uid != os.getuid():
        raise RunError(f"{path}: belongs to somebody else; set XDG_RUNTIME_DIR to a folder of your own")
    return path


class Doorbell:
    """Answers visitors while it is open.

    :param name: what this program is doing, for visitors that find several
    :param answer: called in a thread of its own with what a visitor asks; a GrRos2Error becomes the visitor's
    """

    def __init__(self, name: str, answer: Answer) -> None:
        self._name = name
        self._answer = answer
        self._path = folder() / f"{os.getpid()}.sock"
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._thread = threading.Thread(target=self._serve, name="gr-ros2-doorbell", daemon=True)

    def __enter__(self) -> Doorbell:
        self._path.unlink(missing_ok=True)
        self._socket.bind(str(self._path))
        self._socket.listen()
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._path.unlink(missing_ok=True)
        # Closing alone does not wake a thread that waits in accept.
        with suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._thread.join()
        self._socket.close()

    def _serve(self) -> None:
        while True:
            try:
                visitor, _ = self._socket.accept()
            except OSError:
                return
            with visitor, suppress(OSError):
                visitor.settimeout(_WAIT_S)
                visitor.sendall(json.dumps(self._say(visitor.recv(_LINE))).encode() + b"\n")

    def _say(self, line: bytes) -> Mapping[str, Any]:
        try:
            asked = json.loads(line)
            return {"name": self._name, **(self._answer(asked) if asked else {})}
        except GrRos2Error as error:
            return {"error": str(error)}
        except (ValueError, LookupError, TypeError):
            return {"error": "not understood"}


def neighbours() -> dict[int, str]:
    """What this user's programs are doing, by process id."""
    found = {}
    for path in sorted(folder().glob("*.sock")):
        try:
            found[int(path.stem)] = str(_ask(path, {}).get("name", "?"))
        except (ConnectionRefusedError, FileNotFoundError):
            path.unlink(missing_ok=True)
        except (OSError, ValueError):
            continue
    return found


def ring(pid: int, asked: Mapping[str, Any]) -> Mapping[str, Any]:
    """Ask a program.

    :raises RunError: when it is gone, does not answer, or refuses
    """
    try:
        said = _ask(folder() / f"{pid}.sock", asked)
    except (OSError, ValueError) as error:
        raise RunError(f"process {pid}: does not answer ({error}); has it ended?") from error
    if "error" in said:
        raise RunError(f"process {pid}: {said['error']}")
    return said


def _ask(path: Path, asked: Mapping[str, Any]) -> Mapping[str, Any]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as visitor:
        visitor.settimeout(_WAIT_S)
        visitor.connect(str(path))
        visitor.sendall(json.dumps(asked).encode() + b"\n")
        said: Mapping[str, Any] = json.loads(visitor.makefile().readline())
        return said
