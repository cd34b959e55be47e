"""What the radio tests share: a robot whose ROS graph is in memory, with its link, and what its programs hear."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from types import TracebackType
from typing import Any

from gr_ros2.middleware import Qos
from gr_ros2.middleware.memory import MemoryMiddleware
from gr_ros2.radio.config import LinkConfig, link_from
from gr_ros2.radio.robot_link import LinkObserver, RobotLink
from tests.domains import domain
from tests.middleware.support import CUSTOM, message
from tests.programs import run_program
from tests.waiting import wait_for

ROOT = Path(__file__).resolve().parents[2]
TOPICS = Path(__file__).with_name("topics.csv")
RATE = 2e6
QOS = Qos("reliable", "volatile", 0)


def config(number: int, front_end: dict[str, Any], **values: Any) -> LinkConfig:
    """Of robot ``number``: one topic, packets of 64 B, its graph in memory."""
    defaults = {
        "robot": f"/robot_{number}",
        "registry": str(TOPICS),
        "packet_len": 64,
        "phy": {"name": "psk", "sample_rate": RATE, "options": {"lengths": "fixed"}},
        "front_end": front_end,
        "transmit": values.pop("transmit", True),
        "open": "key" not in values,
        "queue_depth": 0,
        "graph": {"middleware": "memory", "domain_id": domain(number), "depth": 0, **values.pop("graph", {})},
        "publish": {"depth": 0, **values.pop("publish", {})},
    }
    return link_from({**defaults, **values})


class Robot:
    """A robot's programs and its link, which is started and stopped with it.

    :param hears: robots whose messages its programs take
    """

    def __init__(
        self,
        number: int,
        front_end: dict[str, Any],
        hears: tuple[int, ...] = (),
        observer: LinkObserver | None = None,
        *,
        instrumented: bool = False,
        **values: Any,
    ) -> None:
        self.link = RobotLink(config(number, front_end, **values), observer=observer, instrumented=instrumented)
        self.heard: list[bytes] = []
        self._graph = MemoryMiddleware(domain_id=domain(number))
        self._chat = self._graph.advertise(f"/robot_{number}/chat", CUSTOM, QOS)
        for other in hears:
            self._graph.subscribe(f"/rx_robot_{other}/chat", CUSTOM, QOS, self.heard.append)

    def say(self, *numbers: int) -> list[bytes]:
        """Publish numbered messages of several packets each, which the link has then taken; returns them."""
        said = [message(number, 200) for number in numbers]
        for payload in said:
            self.publish(payload)
        return said

    def publish(self, payload: bytes) -> None:
        """Publish a message, which the link has then taken."""
        before = self.taken()
        self._chat.publish(payload)
        wait_for(lambda: self.taken() == before + 1, "the link to take what was said")

    def counters(self) -> dict[str, int]:
        """Counters of the front end: what passed, and what was lost."""
        front_end = self.link.stats()["front_end"]
        return {**front_end["passed"], **front_end["lost"]}

    @property
    def silent(self) -> bool:
        """Whether everything said is on the air or over."""
        packets = self.link.stats()["packets"]
        return self.link.source.idle and packets["out"] == self.link.source.stats()["packets"]

    def taken(self) -> int:
        """Messages that the link has taken."""
        return int(self.link.stats()["source"]["topics"][f"/robot_{self.link.source.src_id}/chat"]["submitted"])

    def __enter__(self) -> Robot:
        self.link.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.link.stop()
        self._graph.close()


def link_command(
    path: Path, front_end: dict[str, Any], sample_rate: float, *options: str, env: dict[str, str] | None = None
) -> subprocess.CompletedProcess[str]:
    """``gr-ros2 link`` in a process of its own, on a configuration file that is written for it."""
    path.write_text(
        f"""
        registry: {TOPICS}
        robot: 1
        graph: {{middleware: memory}}
        phy: {{name: psk, sample_rate: {sample_rate}}}
        front_end: {json.dumps(front_end)}
        transmit: true
        open: true
        """
    )
    command = [sys.executable, "-m", "gr_ros2.cli", "link", str(path), *options]
    return run_program(command, env=env, capture_output=True, text=True, cwd=ROOT, check=False)
