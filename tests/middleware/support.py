"""What the middleware tests share: QoS, numbered messages, and peers in other processes."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Sequence

from gr_ros2.middleware import Qos
from tests.spoken import Spoken

STRING, CUSTOM = "std_msgs/msg/String", "robot_msgs/msg/WheelState"
RELIABLE = Qos("reliable", "volatile", 0)
BEST_EFFORT = Qos("best_effort", "volatile", 100)
LATCHED = Qos("reliable", "transient_local", 10)
ADAPT = Qos(depth=100)


def message(number: int, size: int = 16) -> bytes:
    """A CDR message of a size divisible by 4 that tells its number."""
    return b"\0\1\0\0" + number.to_bytes(4, "little") + bytes((number + i) % 256 for i in range(size - 8))


def same(received: bytes, sent: bytes, padding: int) -> bool:
    """Byte for byte, with at most so many zeros behind."""
    rest = received[len(sent) :]
    return received.startswith(sent) and len(rest) <= padding and not rest.strip(b"\0")


class Peer(Spoken):
    """A publisher or subscriber in another process: ``ready``, ``matched N``, ``data HEX`` out, hex lines in.

    Ours also says ``counters JSON``, a server ``asked`` for each request, and a node ``heard TOPIC``.
    """

    def __init__(self, command: Sequence[str], environment: dict[str, str] | None = None) -> None:
        self.matched = 0
        self.received: list[bytes] = []
        self.counters: dict[str, int] = {}
        self.ready = False
        self.asked = 0
        self.heard: set[str] = set()
        super().__init__(command, env={**os.environ, **(environment or {})})

    def take(self, line: str) -> None:
        word, _, rest = line.strip().partition(" ")
        if word == "ready":
            self.ready = True
        elif word == "matched":
            self.matched = int(rest)
        elif word == "counters":
            self.counters = json.loads(rest)
        elif word == "data":
            self.received.append(bytes.fromhex(rest))
        elif word == "asked":
            self.asked += 1
        elif word == "heard":
            self.heard.add(rest)

    def publish(self, payloads: Iterable[bytes]) -> None:
        self.tell(*(payload.hex() for payload in payloads))

    def signal(self, number: int) -> None:
        self.process.send_signal(number)
