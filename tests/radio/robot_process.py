"""A robot in a process of its own, which a test can kill: its programs, and its link with a graph in memory.

Processes are forked from one that has loaded GNU Radio already, so that many restarts take little time.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Mapping
from math import inf
from multiprocessing.connection import Connection
from typing import Any, NamedTuple

from gr_ros2.core.forks import FORKS, load_for_forks
from gr_ros2.link.events import Received, ReceiverEvent, Rejected
from gr_ros2.middleware.memory import MemoryMiddleware
from gr_ros2.radio.robot_link import RobotLink
from tests.domains import domain
from tests.middleware.support import CUSTOM, message
from tests.radio.robots import QOS, config

PERIODS_S = {1: 0.05, 2: 0.06}
"""s between two messages of a robot, on its link's clock, which in lock step is slower than this machine's. They
differ, so that robots that begin together do not go on sending together."""


class Heard(NamedTuple):
    """A message that came out on the robot's graph.

    :param packets: packets that the link had received by then
    :param restarts: of the other robot, which the link had counted by then
    """

    number: int
    packets: int
    restarts: int


class _Counts:
    """Counts what arrives from the air."""

    def __init__(self) -> None:
        self.packets = 0

    def receiver_event(self, event: ReceiverEvent, now: float) -> None:  # noqa: ARG002
        self.packets += isinstance(event, Received | Rejected)

    def sender_event(self, src_id: int, event: object) -> None:
        pass


def _run(number: int, front_end: dict[str, Any], first: int, values: Mapping[str, Any], pipe: Connection) -> None:
    counts, parent = _Counts(), os.getppid()

    def hear(payload: bytes) -> None:
        pipe.send(
            Heard(int.from_bytes(payload[4:8], "little"), counts.packets, link.front_end.counters().lost["restarts"])
        )

    with MemoryMiddleware(domain_id=domain(number)) as graph:
        link = RobotLink(config(number, front_end, **values), observer=counts)
        graph.subscribe(f"/rx_robot_{3 - number}/chat", CUSTOM, QOS, hear)
        chat = graph.advertise(f"/robot_{number}/chat", CUSTOM, QOS)
        link.start()
        clock, said = link.front_end.clock, -inf
        while os.getppid() == parent:
            if clock() - said >= PERIODS_S[number]:
                chat.publish(message(first, 100))
                first, said = first + 1, clock()
            time.sleep(0.01)


class RobotProcess:
    """One robot, its programs and its link, in a process that a test can kill.

    :param first: number of the first message that it publishes; each further one is one higher
    :ivar heard: messages of the other robot, in the order in which they came out
    """

    def __init__(self, number: int, front_end: dict[str, Any], first: int, **values: Any) -> None:
        self._heard: list[Heard] = []
        self._killed = False
        load_for_forks(__name__, "gr_ros2.phy.psk", "gr_ros2.radio.zmq", "gr_ros2.compression")
        self._pipe, theirs = FORKS.Pipe(duplex=False)
        self._process = FORKS.Process(target=_run, args=(number, front_end, first, values, theirs), daemon=True)
        self._process.start()
        theirs.close()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def kill(self) -> list[Heard]:
        """SIGKILL; what was heard until then."""
        self._killed = True
        self._process.kill()
        self._process.join()
        self._reader.join()
        self._pipe.close()
        return self.heard

    @property
    def heard(self) -> list[Heard]:
        """Messages of the other robot. Who waits for more of a process that has ended by itself is told so at once."""
        assert self._killed or self.alive, f"the process of a robot has ended with code {self._process.exitcode}"
        return self._heard

    @property
    def alive(self) -> bool:
        return self._process.is_alive()

    def _read(self) -> None:
        while True:
            try:
                self._heard.append(self._pipe.recv())
            except (EOFError, OSError):
                return
