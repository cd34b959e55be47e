"""A live link with too much to send: an image of 5 MB beside odometry and scans, and a topic with ``max_rate``.

Each end runs in a process of its own, as on two robots. Their radios are connected by ZeroMQ, their ROS graphs are in
memory. Without and with the image, the same link carries the same topics one after the other.
"""

from __future__ import annotations

import multiprocessing
import random
import time
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from hashlib import blake2b
from itertools import pairwise
from math import inf
from multiprocessing.connection import Connection
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from bench.live import DOMAINS, zmq_link
from bench.repair import quantile
from bench.rows import Row
from gr_ros2.middleware import Publisher, Qos
from gr_ros2.middleware.memory import MemoryMiddleware
from gr_ros2.middleware.type_definitions import typestore
from gr_ros2.radio.robot_link import RobotLink
from gr_ros2_lab.sim.fleet import Fleet
from gr_ros2_lab.sim.sim_settings import SimSettings

TYPES = {"odom": "nav_msgs/msg/Odometry", "scan": "sensor_msgs/msg/LaserScan", "image": "sensor_msgs/msg/Image"}
PERIODIC = ("odom", "scan")
IMAGE_BYTES = 5_000_000
PACKET_LEN = 220
QUIET_S, MOST_S = 15.0, 240.0
OLDER = 1.3
"""Mean age of odometry, and mean and p99 of the age of scans, beside the image over that without it, at most."""
MAX_RATE, HZ = 5.0, 35.0
_QOS = Qos("reliable", "volatile", 10)


@dataclass
class Graph:
    """What robot 1 publishes and robot 2 hears.

    :ivar published: times in s by topic and content
    :ivar came: times in s of publication and delivery, by topic
    """

    published: dict[str, dict[bytes, float]] = field(default_factory=lambda: {name: {} for name in TYPES})
    came: dict[str, list[tuple[float, float]]] = field(default_factory=lambda: {name: [] for name in TYPES})

    def heard(self, name: str, content: bytes, now: float) -> None:
        """A message came out at robot 2."""
        at = self.published[name].get(content)
        if at is not None:
            self.came[name].append((at, now))

    def ages(self, name: str) -> tuple[float, float]:
        """Mean over time, and 99 % quantile just before the next message comes, of the newest message's age, s."""
        came = self.came[name]
        oldest = [(at - before, now - before, now - then) for (before, then), (at, now) in pairwise(came)]
        area = sum((2 * peak - span) / 2 * span for _, peak, span in oldest)
        return area / (came[-1][1] - came[0][1]), quantile([peak for _, peak, _ in oldest], 0.99)

    def publish(self, publisher: Publisher, name: str, payload: bytes) -> None:
        """Publish a message at robot 1."""
        self.published[name][_content(payload)] = time.monotonic()
        publisher.publish(payload)


class Pair:
    """Two linked robots. Robot 1 has odometry, scans and an image."""

    def __init__(self, folder: Path, stack: ExitStack, **options: Any) -> None:
        (folder / "topics.csv").write_text("".join(f"{name},{kind}\n" for name, kind in TYPES.items()))
        self.graph = Graph()
        context = multiprocessing.get_context("spawn")
        self._far, far = context.Pipe()
        robot = context.Process(target=_robot_2, args=(far, folder))
        robot.start()
        stack.callback(robot.join)
        stack.callback(self._far.send, "the end")
        self._far.recv()
        stack.enter_context(_link(1, folder, options))
        graph = stack.enter_context(MemoryMiddleware(domain_id=DOMAINS[0]))
        self._publishers = {name: graph.advertise(f"/robot_1/{name}", kind, _QOS) for name, kind in TYPES.items()}
        fleet = Fleet(SimSettings(robots=1, odom_rate=HZ))
        self._drive = iter(fleet.messages(600.0, topics={f"/robot_1/{name}" for name in PERIODIC}))
        self._offset = 0.0

    def image(self) -> None:
        """Publish an image that cannot be compressed."""
        types, data = typestore().types, random.Random(1).randbytes(IMAGE_BYTES)
        header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](0, 0), "camera")
        array = np.frombuffer(data, np.uint8)
        image = types[TYPES["image"]](header, 1000, 5000, "mono8", 0, 5000, array)
        self.graph.publish(self._publishers["image"], "image", bytes(typestore().serialize_cdr(image, TYPES["image"])))

    def run(self, seconds: float, *, until_image: bool = False) -> dict[str, tuple[float, float]]:
        """Publish for so long, or until an image came; the ages of odometry and scans meanwhile."""
        came = self.graph.came
        for times in came.values():
            times.clear()
        begin = time.monotonic()
        while time.monotonic() - begin < seconds and not (until_image and came["image"]):
            message = next(self._drive)
            self._offset = self._offset or begin - message.t
            time.sleep(max(0.0, message.t + self._offset - time.monotonic()))
            name = message.topic.rsplit("/", 1)[-1]
            self.graph.publish(self._publishers[name], name, message.payload)
            while self._far.poll():
                self.graph.heard(*self._far.recv())
        return {name: self.graph.ages(name) for name in PERIODIC}


def live_image() -> list[Row]:
    """Odometry and scans beside an image on a psk link; odometry with a maximum rate."""
    rows: list[Row] = []
    with TemporaryDirectory() as folder, ExitStack() as stack:
        pair = Pair(Path(folder), stack)
        pair.run(3.0)
        alone = pair.run(QUIET_S)
        pair.image()
        beside = pair.run(MOST_S, until_image=True)
        for name, number, figure in (("odom", 0, "mean age"), ("scan", 0, "mean age"), ("scan", 1, "p99 of the age")):
            before, now = alone[name][number], beside[name][number]
            note = f"{now * 1e3:.0f} ms, without {before * 1e3:.0f} ms"
            what = f"live link beside an image of 5 MB: {name}, {figure} over that without"
            rows.append(Row(what, now / before, "", "≤", OLDER, "{:.2f}", note))
        after = [now - at for at, now in pair.graph.came["image"]] or [inf]
        rows.append(Row("live link: image of 5 MB beside odometry and scans, after", after[0], "s", form="{:.0f}"))
    with TemporaryDirectory() as folder, ExitStack() as stack:
        pair = Pair(Path(folder), stack, odom={"max_rate": MAX_RATE})
        pair.run(3.0)
        _, oldest = pair.run(10.0)["odom"]
        count = len(pair.graph.came["odom"])
        rows.append(Row("live link, max_rate 5 of 35 Hz: delivered", count / 10.0, "1/s", "≤", 5.5, "{:.1f}"))
        rows.append(Row("live link, max_rate 5 of 35 Hz: p99 of the age", oldest, "s", "≤", 0.5, "{:.2f}"))
    return rows


def _content(payload: bytes) -> bytes:
    return blake2b(payload[:-3], digest_size=16).digest()  # DDS pads to 4 bytes


def _robot_2(near: Connection, folder: Path) -> None:
    """Robot 2 in its process: tells what came out, and when, until it is told to end."""
    with _link(2, folder, {}), MemoryMiddleware(domain_id=DOMAINS[1]) as graph:

        def heard(name: str, payload: bytes) -> None:
            near.send((name, _content(payload), time.monotonic()))

        for name, kind in TYPES.items():
            graph.subscribe(f"/rx_robot_1/{name}", kind, _QOS, partial(heard, name))
        near.send("ready")
        near.recv()


def _link(number: int, folder: Path, options: dict[str, Any]) -> RobotLink:
    return zmq_link(
        number,
        folder,
        registry=str(folder / "topics.csv"),
        packet_len=PACKET_LEN,
        phy={"name": "psk", "sample_rate": 1e6},
        topics={"auto": None, **options},
    )
