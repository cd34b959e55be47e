"""What a live link costs: processor time of two robots at 35 Hz odometry, with version 1 beside version 0.

Both ends run in this process, their radios are connected by ZeroMQ and their ROS graphs are in memory. The two versions
run in turn, so that a slow moment of the machine hits both; everything but the version is the same.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import ExitStack
from itertools import cycle
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any

from bench.rows import Row
from gr_ros2.middleware import Publisher, Qos
from gr_ros2.middleware.memory import MemoryMiddleware
from gr_ros2.radio.config import link_from
from gr_ros2.radio.robot_link import RobotLink
from gr_ros2.settings.files import find_registry
from gr_ros2_lab.sim.fleet import Fleet
from gr_ros2_lab.sim.sim_settings import SimSettings

REPEATS, WARM_UP_S, MEASURED_S = 5, 3.0, 8.0
RATE_HZ = 35.0
MOST = 1.10
"""Processor time with version 1 over that with version 0."""
DOMAINS = (91, 92)


def live() -> list[Row]:
    """Processor time of both ends together, as a share of one core."""
    shares: dict[int, list[float]] = {0: [], 1: []}
    for _ in range(REPEATS):
        for version, found in shares.items():
            found.append(_share(version))
    old, new = (median(found) for found in shares.values())
    note = f"{new:.1%} of a core instead of {old:.1%}"
    return [Row("live link, 35 Hz odometry: version 1 over version 0", new / old, "", "≤", MOST, "{:.2f}", note)]


def _share(version: int) -> float:
    """Processor time over time while robot 1 sends odometry to robot 2."""
    topic = "/robot_1/odom"
    settings = SimSettings(robots=2, odom_rate=RATE_HZ)
    messages = [sent.payload for sent in Fleet(settings).messages(WARM_UP_S + MEASURED_S, topics={topic})]
    with TemporaryDirectory() as folder, ExitStack() as stack:
        settings: dict[str, Any] = {
            "registry": str(find_registry("odom", Path())),
            "packet_len": 64,
            "version": version,
            "phy": {"name": "ofdm", "sample_rate": 1e5},
            "ros_source": {"compression": True},
        }
        links = [zmq_link(number, Path(folder), **settings) for number in (1, 2)]
        graph = MemoryMiddleware(domain_id=DOMAINS[0])
        stack.callback(graph.close)
        for link in links:
            stack.enter_context(link)
        publisher = graph.advertise(topic, "nav_msgs/msg/Odometry", Qos("reliable", "volatile", 10))
        _publish(publisher, payloads := cycle(messages), WARM_UP_S)
        before, begin = _delivered(links[1]), time.process_time()
        _publish(publisher, payloads, MEASURED_S)
        share = (time.process_time() - begin) / MEASURED_S
        least = 0.9 * RATE_HZ * MEASURED_S
        if _delivered(links[1]) - before < least:
            raise SystemExit(f"bench live: {_delivered(links[1]) - before} messages with version {version}")
    return share


def zmq_link(number: int, folder: Path, **values: Any) -> RobotLink:
    """One of two robots, over ZeroMQ; its ROS graph is in memory.

    :param folder: where both keep their states and sockets
    :param values: settings of the link beside these
    """
    own, other = (f"ipc://{folder}/{end}" for end in (number, 3 - number))
    graph: dict[str, Any] = {"middleware": "memory", "domain_id": DOMAINS[number - 1]}
    source = {"namespace": f"/robot_{number}", **graph, **values.pop("ros_source", {})}
    ends = {"name": "zmq", "bind": own, "connect": [other]}
    if values.get("version", 1):
        values["state"] = str(folder / f"state-{number}")
    return RobotLink(link_from({"front_end": ends, "ros_source": source, "ros_sink": graph, **values}))


def _publish(publisher: Publisher, payloads: Iterator[bytes], seconds: float) -> None:
    begin = time.monotonic()
    for number in range(round(seconds * RATE_HZ)):
        time.sleep(max(0.0, begin + number / RATE_HZ - time.monotonic()))
        publisher.publish(next(payloads))
    time.sleep(max(0.0, begin + seconds - time.monotonic()))


def _delivered(link: RobotLink) -> int:
    return sum(topic["delivered"] for topic in link.stats()["sink"]["topics"].values())
