"""Servers and clients of AddTwoInts for tests: ours on any middleware, and others in processes of their own."""

from __future__ import annotations

import os
import signal
import struct
import sys
from collections.abc import Hashable
from pathlib import Path

from gr_ros2.middleware.services import ServiceGraph
from tests.spoken import Spoken

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


class Program(Spoken):
    """``service_peer.py`` in a process; see there."""

    def __init__(self, domain: int, service: str, role: str) -> None:
        command = [sys.executable, "-m", "tests.middleware.service_peer", str(domain), service, role]
        super().__init__(command, cwd=Path(__file__).parents[2], env={**os.environ, "CYCLONEDDS_URI": LOOPBACK})

    def heard(self, word: str) -> list[list[int]]:
        """The numbers said behind a word, line by line."""
        lines = [line.split() for line in list(self.said)]
        return [[int(number) for number in line[1:]] for line in lines if line[0] == word]

    @property
    def ready(self) -> bool:
        return "ready" in self.said

    @property
    def there(self) -> bool:
        """Whether a client has found a server."""
        return self.heard("servers")[-1:] not in ([], [[0]])

    def call(self, number: int) -> None:
        """Have a client ask for ``number`` + 1000."""
        self.tell(f"{number} 1000")

    def kill(self) -> None:
        """End it without a word to the graph, which misses it some seconds later."""
        self.end(signal.SIGKILL)
