"""How long a link is without data when its radio vanishes and comes back, and whether messages are lost meanwhile.

Two links on a serial line, which is a pair of pseudo terminals: both devices disappear, and appear again under the same
names. The time runs from the moment at which they are there again to the arrival of the message that was published
while they were away.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any

from bench.rows import Row
from gr_ros2.middleware import Qos
from gr_ros2.middleware.memory import MemoryMiddleware
from gr_ros2.radio.config import link_from
from gr_ros2.radio.robot_link import RobotLink
from tests.radio.cables import SerialCable

TIMES, AWAY_S = 7, 2.0
MOST_S = 2.0
"""A device is tried again every second; then a repair has to cross."""
_DOMAINS = (93, 94)
_TYPE, _QOS = "std_msgs/msg/UInt32", Qos("reliable", "volatile", 0)
_PATIENCE_S = 10.0
"""s after which a message counts as lost: the whole takes less than 2 minutes, whatever happens."""


def reopen() -> list[Row]:
    """s until data flows again, and messages that did not arrive."""
    took: list[float] = []
    heard: list[bytes] = []
    with TemporaryDirectory() as folder, SerialCable(Path(folder)) as cable, ExitStack() as stack:
        for number, end in enumerate(cable.ends, 1):
            stack.enter_context(RobotLink(_config(number, str(end), folder)))
        graphs = [stack.enter_context(MemoryMiddleware(domain_id=domain)) for domain in _DOMAINS]
        publisher = graphs[0].advertise("/robot_1/count", _TYPE, _QOS)
        graphs[1].subscribe("/rx_robot_1/count", _TYPE, _QOS, heard.append)

        def wait(done: Callable[[], object]) -> float:
            begin = time.monotonic()
            while not done() and time.monotonic() < begin + _PATIENCE_S:
                time.sleep(0.002)
            return time.monotonic() - begin

        wait(publisher.matched)
        for number in range(TIMES + 1):
            if number:
                cable.pull()
            payload = b"\0\1\0\0" + number.to_bytes(4, "little")
            publisher.publish(payload)
            if number:
                time.sleep(AWAY_S)
                cable.plug()
            took.append(wait(lambda: payload in heard))  # noqa: B023 - called at once
    never = f"the first message, without an interruption: {took[0]:.2f} s; the longest: {max(took[1:]):.2f} s"
    return [
        Row("serial line gone for 2 s: until data flows again", median(took[1:]), "s", "≤", MOST_S, "{:.2f}", never),
        Row("messages published meanwhile that did not arrive", TIMES + 1 - len(set(heard)), "", "=", 0),
    ]


def _config(number: int, device: str, folder: str) -> Any:
    graph = {"middleware": "memory", "domain_id": _DOMAINS[number - 1]}
    return link_from(
        {
            "robot": f"/robot_{number}",
            "topics": ["count"],
            "graph": graph,
            "phy": {"name": "modem", "options": {"bit_rate": 57_600.0}},
            "front_end": {"name": "serial", "device": device},
            "state": f"{folder}/state-{number}",
            "transmit": True,
            "open": True,
        }
    )
