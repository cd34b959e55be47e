"""Two robots in this process with a live link between them, OFDM over ZeroMQ, for tests of services and actions."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from gr_ros2.middleware.dds import DdsMiddleware
from gr_ros2.middleware.memory import MemoryMiddleware
from gr_ros2.middleware.services import ServiceGraph
from gr_ros2.radio.config import link_from
from gr_ros2.radio.robot_link import RobotLink
from tests.domains import free_domains


class Robots:
    """Two robots; the second has the services of a row. ``graphs`` are those of their programs.

    :param row: of the registry; '' for none
    :param topics: words with which both find topics and services on their graphs
    :param offer: what the second sends when it is asked
    :param channel: impairments at both receivers
    """

    def __init__(
        self,
        folder: Path,
        row: str,
        middleware: str = "memory",
        *,
        topics: Sequence[str] = (),
        offer: Any = (),
        **channel: Any,
    ) -> None:
        self._offer = offer
        self._folder, self._channel, self._middleware, self._topics = folder, channel, middleware, list(topics)
        self._registry = bool(row)
        self._domains = free_domains(2)
        (folder / "services.csv").write_text(f"{row}\n")
        self.stack = ExitStack()
        make = {"memory": MemoryMiddleware, "dds": DdsMiddleware}[middleware]
        self.graphs: list[ServiceGraph] = [
            self.stack.enter_context(make(domain_id=domain, node_name="programs")) for domain in self._domains
        ]
        self.links: dict[int, RobotLink] = {}
        for number in (1, 2):
            self.start(number)
        self.stack.callback(lambda: [link.stop() for link in self.links.values()])

    def start(self, number: int, **values: Any) -> None:
        own, other = (f"ipc://{self._folder}/{robot}" for robot in (number, 3 - number))
        graph = {"middleware": self._middleware, "domain_id": self._domains[number - 1]}
        settings: dict[str, Any] = {
            "registry": str(self._folder / "services.csv") if number == 2 and self._registry else "",
            "packet_len": 64,
            "phy": {"name": "ofdm", "sample_rate": 4e5},
            "front_end": {"name": "zmq", "bind": own, "connect": [other]},
            "channel": {"seed": number, **self._channel},
            "state": str(self._folder / f"state-{number}"),
            "robot": f"/robot_{number}",
            "topics": self._topics or ["auto"] * bool(values.get("registry", number == 2 and self._registry)),
            "offer": self._offer if number == 2 else [],
            "graph": graph,
        }
        link = self.links[number] = RobotLink(link_from({**settings, **values}))
        link.start()

    def restart(self, number: int) -> None:
        self.links[number].stop()
        self.start(number)

    def counted(self, number: int) -> dict[str, int]:
        found: dict[str, int] = self.links[number].stats()["calls"]["counters"]
        return found
