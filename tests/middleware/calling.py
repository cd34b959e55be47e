"""Servers and clients of AddTwoInts for tests: ours on any middleware, and others in processes of their own."""

from __future__ import annotations

import os
import struct
import subprocess
import sys
import threading
from collections.abc import Hashable
from contextlib import suppress
from pathlib import Path

from gr_ros2.middleware.services import ServiceGraph
from tests.waiting import PATIENCE_S

ADD = "example_interfaces/srv/AddTwoInts"
LOOPBACK = (
    '<General><Interfaces><NetworkInterface address="127.0.0.1"/></Interfaces></General><Discovery>'
    '<ParticipantIndex>auto</ParticipantIndex><Peers><Peer address="127.0.0.1"/></Peers></Discovery>'
)
_HEAD = b"\0\1\0\0"


def request(a: int, b: int = 0) -> bytes:
    return _HEAD + struct.pack("<qq", a, b)


def total(reply: bytes) -> int:
    return int(struct.unpack("<q", reply[4:12])[0])


class Adder:
    """A server.

    :ivar taken: first operand of every request
    """

    def __init__(self, graph: ServiceGraph, service: str) -> None:
        self.taken: list[int] = []
        self.server = graph.serve(service, ADD, self._take)

    def _take(self, client: Hashable, payload: bytes) -> None:
        a, b = struct.unpack("<qq", payload[4:20])
        self.taken.append(a)
        self.server.reply(client, _HEAD + struct.pack("<q", a + b))


class Caller:
    """A client.

    :ivar there: whether a server is
    :ivar got: results by number
    """

    def __init__(self, graph: ServiceGraph, service: str) -> None:
        self.there = False
        self.got: dict[int, list[int]] = {}
        self.client = graph.client(service, ADD, self._take, self._changed)

    def call(self, number: int) -> None:
        """Ask for ``number`` + 1000."""
        self.client.call(number, request(number, 1000))

    def _take(self, number: int, payload: bytes) -> None:
        self.got.setdefault(number, []).append(total(payload))

    def _changed(self, there: bool) -> None:
        self.there = there


class Program:
    """``service_peer.py`` in a process; see there."""

    def __init__(self, domain: int, service: str, role: str) -> None:
        self.said: list[list[str]] = []
        peer = Path(__file__).with_name("service_peer.py")
        self.process = subprocess.Popen(
            [sys.executable, "-m", f"tests.middleware.{peer.stem}", str(domain), service, role],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            bufsize=1,
            cwd=Path(__file__).parents[2],
            env={**os.environ, "CYCLONEDDS_URI": LOOPBACK},
        )
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        self.said.extend(line.split() for line in self.process.stdout)

    def heard(self, word: str) -> list[list[int]]:
        """The numbers said behind a word, line by line."""
        return [[int(number) for number in line[1:]] for line in list(self.said) if line[0] == word]

    @property
    def ready(self) -> bool:
        return ["ready"] in self.said

    @property
    def there(self) -> bool:
        """Whether a client has found a server."""
        return self.heard("servers")[-1:] not in ([], [[0]])

    def call(self, number: int) -> None:
        """Have a client ask for ``number`` + 1000."""
        assert self.process.stdin is not None
        self.process.stdin.write(f"{number} 1000\n")

    def kill(self) -> None:
        """End it without a word to the graph, which misses it some seconds later."""
        self.process.kill()
        self.close()

    def close(self) -> None:
        """End of input makes it leave the graph; if it does not, it is ended."""
        assert self.process.stdin is not None and self.process.stdout is not None
        if not self.process.stdin.closed:
            with suppress(BrokenPipeError):
                self.process.stdin.close()
        try:
            self.process.wait(PATIENCE_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        self._thread.join(PATIENCE_S)
        self.process.stdout.close()
