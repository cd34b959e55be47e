"""What the middleware tests share: QoS, numbered messages, and peers in other processes."""

from __future__ import annotations

import json
import os
import subprocess
import threading
from collections.abc import Iterable, Sequence

from gr_ros2.middleware import Qos
from tests.waiting import PATIENCE_S

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


class Peer:
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
        self._process = subprocess.Popen(
            list(command),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            bufsize=1,
            env={**os.environ, **(environment or {})},
        )
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
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
        assert self._process.stdin is not None
        for payload in payloads:
            self._process.stdin.write(payload.hex() + "\n")
        self._process.stdin.flush()

    def signal(self, number: int) -> None:
        self._process.send_signal(number)

    def close(self) -> None:
        """End of input makes a peer leave the graph; one that does not is ended."""
        assert self._process.stdin is not None and self._process.stdout is not None
        if not self._process.stdin.closed:
            self._process.stdin.close()
        try:
            self._process.wait(PATIENCE_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._thread.join(PATIENCE_S)
        self._process.stdout.close()
