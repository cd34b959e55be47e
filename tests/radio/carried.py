"""One burst that crosses a medium process, handed over without sockets, so that the same comes out each time."""

from __future__ import annotations

from itertools import count
from math import isnan
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from gr_ros2.radio.zmq import HEADER, MAGIC, SAMPLE
from gr_ros2.settings.config import build
from gr_ros2_lab.medium.process import MediumConfig, MediumProcess

RATE = 2e6
BEGINS_S, CALLS = 0.004, 40


class Ear:
    """In place of the socket to a link."""

    def __init__(self) -> None:
        self.heard: list[bytes] = []

    def send(self, message: bytes, _: int) -> None:
        self.heard.append(message)


def carried(*robots: dict[str, Any], **changes: Any) -> tuple[dict[str, int], list[Any]]:
    """What a medium counts and what each robot gets where robot 1 sends one burst.

    :param robots: further settings of each robot
    :param changes: settings of the medium
    :return: for each robot whether what it gets has times, how long its messages are, and their samples
    """
    with TemporaryDirectory() as folder:
        ends = [
            {"connect": f"ipc://{folder}/robot{n}", "bind": f"ipc://{folder}/medium{n}", **own}
            for n, own in enumerate(robots or ({}, {}))
        ]
        ticks = count()
        medium = MediumProcess(
            build(MediumConfig, {"phy": {"name": "psk", "sample_rate": RATE}, "robots": ends, **changes}),
            clock=lambda: 0.002 * next(ticks),
        )
        try:
            ears = [Ear() for _ in ends]
            for link, ear in zip(medium._links, ears, strict=True):
                link.publisher = ear
            burst = np.exp(0.3j * np.arange(500)).astype(SAMPLE).tobytes()
            medium._arrived(0, HEADER.pack(MAGIC, 1, 0, RATE, BEGINS_S) + burst)
            medium._links[0].heard = -np.inf  # nobody is waited for
            medium.run(0.002 * CALLS)
        finally:
            medium.close()
        return dict(medium.counted), [_of(ear.heard) for ear in ears]


def _of(messages: list[bytes]) -> tuple[set[bool], list[int], bytes]:
    parts = [message[HEADER.size :] for message in messages]
    return {isnan(HEADER.unpack_from(message)[4]) for message in messages}, list(map(len, parts)), b"".join(parts)


def addresses(**second: str) -> list[str]:
    """Where a medium publishes and subscribes for two robots, the second with other settings; ``{}`` is a folder."""
    with TemporaryDirectory() as folder:
        robots = [{"connect": f"ipc://{folder}/robot{n}", "bind": f"ipc://{folder}/medium{n}"} for n in (1, 2)]
        robots[1] |= {name: text.format(folder) for name, text in second.items()}
        medium = MediumProcess(build(MediumConfig, {"phy": {"name": "psk", "sample_rate": RATE}, "robots": robots}))
        try:
            sockets = [socket for link in medium._links for socket in (link.publisher, link.subscriber)]
            return [socket.last_endpoint.decode().replace(folder, "{}") for socket in sockets]
        finally:
            medium.close()
