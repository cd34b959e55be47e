"""How `gr-ros2 dashboard` finds programs of this user that run now, and asks one of them to show itself.

Each program that can be looked at listens on a Unix socket named after its process in a folder only its user may
enter; a visitor sends one line of JSON and gets one line back. Laws: nobody else can ring; a program that is killed
leaves a socket that answers no more and is cleared away by the next visitor; ringing never holds the program up;
whatever a visitor sends, or does not send, the next one is answered; nobody waits for anybody longer than a deadline,
and nobody keeps more than a line of anybody else's.
"""

from __future__ import annotations

import json
import os
import selectors
import socket
import tempfile
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any

from gr_ros2.errors import GrRos2Error, RunError

_LINE = 4096
_MAX_VISITORS = 32
"""At a door at a time; when one more comes, the one that has said nothing for longest is sent away."""
_SPEAK_S = 2.0
"""s a visitor gets to say what it wants."""
_PAUSE_S = 0.1
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
        self._selector = selectors.DefaultSelector()
        self._visitors: dict[socket.socket, _Visitor] = {}
        self._closed = False
        self._thread = threading.Thread(target=self._serve, name="gr-ros2-doorbell", daemon=True)

    def __enter__(self) -> Doorbell:
        self._path.unlink(missing_ok=True)
        self._socket.bind(str(self._path))
        self._socket.listen()
        self._socket.setblocking(False)
        self._selector.register(self._socket, selectors.EVENT_READ)
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._path.unlink(missing_ok=True)
        self._closed = True
        # Closing alone does not wake a thread that waits for the socket.
        with suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._thread.join()
        self._selector.close()
        self._socket.close()

    def _serve(self) -> None:
        try:
            while self._turn():
                pass
        finally:
            for visitor in list(self._visitors):
                self._leave(visitor)

    def _turn(self) -> bool:
        """Wait for what comes next and see to it; false when the door is closed."""
        first = min((visitor.deadline for visitor in self._visitors.values()), default=None)
        wait = None if first is None else max(0.0, first - time.monotonic())
        for key, _ in self._selector.select(wait):
            if isinstance(key.data, _Visitor):
                self._hear(key.data)
            elif not self._let_in():
                return False
        now = time.monotonic()
        for visitor in [visitor for visitor in self._visitors.values() if visitor.deadline <= now]:
            self._leave(visitor.socket)
        return True

    def _let_in(self) -> bool:
        try:
            came, _ = self._socket.accept()
        except OSError as error:
            if self._closed:
                return False
            if not isinstance(error, BlockingIOError):  # no file descriptor is left: whoever waits has to wait
                time.sleep(_PAUSE_S)
            return True
        came.setblocking(False)
        if len(self._visitors) >= _MAX_VISITORS:
            self._leave(next(iter(self._visitors)))
        visitor = self._visitors[came] = _Visitor(came, time.monotonic() + _SPEAK_S)
        self._selector.register(came, selectors.EVENT_READ, visitor)
        return True

    def _leave(self, visitor: socket.socket) -> None:
        if self._visitors.pop(visitor, None) is not None:
            self._selector.unregister(visitor)
            visitor.close()

    def _hear(self, visitor: _Visitor) -> None:
        try:
            more = visitor.socket.recv(_LINE - len(visitor.line))
        except BlockingIOError:
            return
        except OSError:
            more = b""
        visitor.line += more
        if more and b"\n" not in more and len(visitor.line) < _LINE:
            return
        if visitor.line:
            with suppress(OSError):  # it left, or does not read what fits into its socket's buffer
                visitor.socket.sendall(json.dumps(self._say(visitor.line)).encode() + b"\n")
        self._leave(visitor.socket)

    def _say(self, line: bytes) -> Mapping[str, Any]:
        try:
            asked = parse(line)
            return {"name": self._name, **(self._answer(asked) if asked else {})}
        except GrRos2Error as error:
            return {"error": str(error)}
        except (ValueError, LookupError, TypeError, ArithmeticError):
            return {"error": "not understood"}
        except Exception as error:  # noqa: BLE001 - whatever one visitor brings about, the next one is answered
            return {"error": f"{type(error).__name__}: {error}"}


class _Visitor:
    """Somebody at the door.

    :param deadline: when its line has to be complete, s, monotonic
    """

    __slots__ = ("deadline", "line", "socket")

    def __init__(self, connection: socket.socket, deadline: float) -> None:
        self.socket, self.deadline = connection, deadline
        self.line = b""


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


def parse(line: bytes) -> Mapping[str, Any]:
    """One line of JSON that is an object.

    :raises ValueError: for anything else
    """
    try:
        found = json.loads(line)
    except RecursionError as error:
        raise ValueError("nested too deeply") from error
    if not isinstance(found, Mapping):
        raise ValueError("not a JSON object")
    return found


def receive(connection: socket.socket, most: int, deadline: float, end: bytes = b"") -> bytes:
    """What comes until the other side closes, ``end`` is there, or it is enough.

    :param most: bytes
    :param deadline: s, monotonic
    :raises TimeoutError: when the time is over
    """
    data = b""
    while len(data) < most and not (end and end in data):
        left = deadline - time.monotonic()
        if left <= 0:
            raise TimeoutError("timed out")
        connection.settimeout(left)
        more = connection.recv(most - len(data))
        if not more:
            break
        data += more
    return data


def _ask(path: Path, asked: Mapping[str, Any]) -> Mapping[str, Any]:
    deadline = time.monotonic() + _WAIT_S
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as visitor:
        visitor.settimeout(_WAIT_S)
        visitor.connect(str(path))
        visitor.sendall(json.dumps(asked).encode() + b"\n")
        return parse(receive(visitor, _LINE, deadline, b"\n"))
