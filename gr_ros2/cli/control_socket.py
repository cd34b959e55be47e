"""Unix sockets with which `gr-ros2 dashboard` finds the running programs of this user, and asks one to serve its page.

Each program that can be observed listens on a Unix socket. The socket is named after the process id, in a folder that
only its user may enter. A client sends one line of JSON and gets one line back.

Invariants: no other user can connect. The socket of a killed program answers no more, and the next client removes it. A
request never delays the program. Whatever a client sends or does not send, the next client gets an answer. Every wait
has a deadline. At most one line is kept from each side, of at most ``_LINE`` and ``_ANSWER`` bytes.
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
from math import inf
from pathlib import Path
from typing import Any

from gr_ros2.core.errors import GrRos2Error, RunError, reason, shortened
from gr_ros2.core.watch import LOOK_S, Watch

STATUS, PING, SET, OFFERS, WANT, MEASURE, LISTEN = "status", "ping", "set", "offers", "want", "measure", "listen"
"""Questions to a link."""
LISTEN_S = 600
"""s for which it listens at most when it is asked to."""
_LINE = 4096
"""Most bytes of a request."""
_ANSWER = 1 << 20
"""Most bytes of an answer, such as the status of a link of 240 topics."""
_MAX_CLIENTS = 32
"""Most clients at a time. When one more connects, the client that connected first is disconnected."""
_REQUEST_S = 2.0
"""s that a client may take to send its request."""
_PAUSE_S = 0.1
_WAIT_S = 10.0
"""s that a client waits for the answer. The program draws its dashboard before it answers."""
_OF_OTHERS = ("run/user/*/gr-ros2-*/*.sock", "run/gr-ros2/*/gr-ros2-*/*.sock")
"""Where the programs of other users listen, and services (``gr-ros2@.service``); root alone can look there."""

Answer = Callable[[Mapping[str, Any]], Mapping[str, Any]]


def folder() -> Path:
    """The folder of this user's sockets, created if missing.

    :raises RunError: when another user owns it
    """
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    base = Path(runtime) if runtime and Path(runtime).is_dir() else Path(tempfile.gettempdir())
    path = base / f"gr-ros2-{os.getuid()}"
    path.mkdir(mode=0o700, exist_ok=True)
    if path.stat().st_uid != os.getuid():
        raise RunError(f"{path}: belongs to somebody else; set XDG_RUNTIME_DIR to a folder of your own")
    return path


class ControlSocket:
    """Answers clients while it is open.

    :param name: what this program is doing, for clients that find several programs
    :param answer: called in a separate thread with the request of a client; a GrRos2Error is sent to the client
    """

    def __init__(self, name: str, answer: Answer) -> None:
        self._name = name
        self._answer = answer
        self._path = folder() / f"{os.getpid()}.sock"
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._selector = selectors.DefaultSelector()
        self._clients: dict[socket.socket, _Client] = {}
        self._closed = False
        self._thread = threading.Thread(target=self._serve, name="gr-ros2-control", daemon=True)

    def __enter__(self) -> ControlSocket:
        # A client takes a socket that does not listen for that of a killed program, and removes it.
        starting = self._path.with_suffix(".starting")
        starting.unlink(missing_ok=True)
        self._socket.bind(str(starting))
        self._socket.listen()
        starting.replace(self._path)
        self._socket.setblocking(False)
        self._selector.register(self._socket, selectors.EVENT_READ)
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
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
            while self._handle_next():
                pass
        finally:
            for client in list(self._clients):
                self._disconnect(client)

    def _handle_next(self) -> bool:
        """Wait for the next event and handle it. Return False when the socket is closed."""
        first = min((client.deadline for client in self._clients.values()), default=None)
        wait = None if first is None else max(0.0, first - time.monotonic())
        for key, _ in self._selector.select(wait):
            if isinstance(key.data, _Client):
                self._read_from(key.data)
            elif not self._accept():
                return False
        now = time.monotonic()
        for client in [client for client in self._clients.values() if client.deadline <= now]:
            self._disconnect(client.socket)
        return True

    def _accept(self) -> bool:
        try:
            connection, _ = self._socket.accept()
        except OSError as error:
            if self._closed:
                return False
            if not isinstance(error, BlockingIOError):  # no file descriptor is left, so new clients wait
                time.sleep(_PAUSE_S)
            return True
        connection.setblocking(False)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _ANSWER)
        if len(self._clients) >= _MAX_CLIENTS:
            self._disconnect(next(iter(self._clients)))
        client = self._clients[connection] = _Client(connection, time.monotonic() + _REQUEST_S)
        self._selector.register(connection, selectors.EVENT_READ, client)
        return True

    def _disconnect(self, client: socket.socket) -> None:
        if self._clients.pop(client, None) is not None:
            self._selector.unregister(client)
            client.close()

    def _read_from(self, client: _Client) -> None:
        try:
            more = client.socket.recv(_LINE - len(client.line))
        except BlockingIOError:
            return
        except OSError:
            more = b""
        client.line += more
        if more and b"\n" not in more and len(client.line) < _LINE:
            return
        if client.line:
            with suppress(OSError):  # the client left, or its buffer is full because it does not read
                client.socket.sendall(json.dumps(self._reply_to(client.line)).encode() + b"\n")
        self._disconnect(client.socket)

    def _reply_to(self, line: bytes) -> Mapping[str, Any]:
        try:
            query = parse(line)
        except ValueError as error:
            return {"error": shortened(f"not understood ({error}); a question is one line of JSON, an object")}
        try:
            return {"name": self._name, **(self._answer(query) if query else {})}
        except GrRos2Error as error:
            return {"error": str(error)}
        except Exception as error:  # noqa: BLE001 - whatever error one client causes, the next one gets an answer
            return {"error": shortened(f"{type(error).__name__}: {error}")}


class _Client:
    """A connected client.

    :param deadline: time at which its line must be complete, s, monotonic
    """

    __slots__ = ("deadline", "line", "socket")

    def __init__(self, connection: socket.socket, deadline: float) -> None:
        self.socket, self.deadline = connection, deadline
        self.line = b""


def sockets() -> dict[int, Path]:
    """The sockets of the programs that this user may ask, by process id: of its own ones, and for root of all users."""
    others = [path for pattern in _OF_OTHERS for path in Path("/").glob(pattern)] if os.geteuid() == 0 else []
    running = [path for path in others if Path("/proc", path.stem).exists()]
    return {int(path.stem): path for path in [*running, *sorted(folder().glob("*.sock"))] if path.stem.isdecimal()}


def running_programs() -> dict[int, str]:
    """Names of the running programs that this user may ask, by process id."""
    found = {}
    for pid, path in sockets().items():
        try:
            found[pid] = str(_ask(path, {}).get("name", "?"))
        except (OSError, ValueError):
            continue
    return found


def request(pid: int, query: Mapping[str, Any]) -> Mapping[str, Any]:
    """Send a request to a program and return its answer.

    :raises RunError: when the program has ended, does not answer, or refuses
    """
    try:
        reply = _ask(sockets().get(pid, folder() / f"{pid}.sock"), query)
    except (OSError, ValueError) as error:
        raise RunError(f"process {pid}: does not answer ({reason(error)}); has it ended?") from error
    if "error" in reply:
        raise RunError(f"process {pid}: {reply['error']}")
    return reply


def parse(line: bytes) -> Mapping[str, Any]:
    """Parse one line of JSON, which must be an object.

    :raises ValueError: for anything else
    """
    try:
        found = json.loads(line)
    except RecursionError as error:
        raise ValueError("nested too deeply") from error
    if not isinstance(found, Mapping):
        raise ValueError("not a JSON object")
    return found


def receive(connection: socket.socket, most: int, timeout_s: float, end: bytes = b"") -> bytes:
    """Receive data until the other side closes, ``end`` has arrived, or there are ``most`` bytes.

    :param most: most bytes to receive
    :param timeout_s: s of this process's own time after which to stop
    :raises TimeoutError: when the time is over
    """
    data, watch = b"", Watch()
    while len(data) < most and not (end and end in data):
        left = timeout_s - watch.age(inf, time.monotonic())
        if left <= 0:
            raise TimeoutError("timed out")
        connection.settimeout(min(left, LOOK_S))
        try:
            more = connection.recv(most - len(data))
        except TimeoutError:
            continue
        if not more:
            break
        data += more
    return data


def _ask(path: Path, query: Mapping[str, Any]) -> Mapping[str, Any]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as client:
        client.settimeout(_WAIT_S)
        try:
            client.connect(str(path))
        except ConnectionRefusedError:  # it was killed
            if path.parent == folder():
                path.unlink(missing_ok=True)
            raise
        client.sendall(json.dumps(query).encode() + b"\n")
        return parse(receive(client, _ANSWER, _WAIT_S, b"\n"))
