"""What a live link costs: processor time of two robots without messages and at 35 and 350 Hz odometry.

Both ends run in this process as ``gr-ros2 link`` makes them, their radios are connected by ZeroMQ and their ROS graphs
are in memory. Beside other programs every figure is larger: compare with another commit in turns.
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
RATES_HZ = (35.0, 350.0)
DOMAINS = (91, 92)


def live() -> list[Row]:
    """Processor time of both ends together, idle as a share of one core."""
    rows = [Row("live link, idle: of a core", median(_share(0.0) for _ in range(REPEATS)), form="{:.2%}")]
    for hz in RATES_HZ:
        share = median(_share(hz) for _ in range(REPEATS))
        note = f"{share:.1%} of a core"
        rows.append(Row(f"live link, {hz:g} Hz odometry: a message", share / hz * 1e3, "ms", form="{:.2f}", note=note))
    return rows


def _share(hz: float) -> float:
    """Processor time over time while robot 1 sends odometry to robot 2."""
    topic = "/robot_1/odom"
    fleet = Fleet(SimSettings(robots=2, odom_rate=RATES_HZ[0]))
    messages = [sent.payload for sent in fleet.messages(WARM_UP_S + MEASURED_S, topics={topic})]
    with TemporaryDirectory() as folder, ExitStack() as stack:
        values: dict[str, Any] = {
            "registry": str(find_registry("odom", Path())),
            "packet_len": 64,
            "phy": {"name": "ofdm", "sample_rate": 1e6},
        }
        links = [zmq_link(number, Path(folder), **values) for number in (1, 2)]
        graph = MemoryMiddleware(domain_id=DOMAINS[0])
        stack.callback(graph.close)
        for link in links:
            stack.enter_context(link)
        publisher = graph.advertise(topic, "nav_msgs/msg/Odometry", Qos("reliable", "volatile", 10))
        _publish(publisher, payloads := cycle(messages), WARM_UP_S, hz)
        before, begin = _delivered(links[1]), time.process_time()
        _publish(publisher, payloads, MEASURED_S, hz)
        share = (time.process_time() - begin) / MEASURED_S
        least = 0.9 * hz * MEASURED_S
        if _delivered(links[1]) - before < least:
            raise SystemExit(f"bench live: {_delivered(links[1]) - before} messages")
    return share


def zmq_link(number: int, folder: Path, **values: Any) -> RobotLink:
    """One of two robots, over ZeroMQ; its ROS graph is in memory.

    :param folder: where both keep their states and sockets
    :param values: settings of the link beside these
    """
    own, other = (f"ipc://{folder}/{end}" for end in (number, 3 - number))
    graph: dict[str, Any] = {"middleware": "memory", "domain_id": DOMAINS[number - 1]}
    ends = {"name": "zmq", "bind": own, "connect": [other]}
    own_values = {"robot": f"/robot_{number}", "graph": graph, "state": str(folder / f"state-{number}")}
    return RobotLink(link_from({"front_end": ends, **own_values, **values}), instrumented=True)


def _publish(publisher: Publisher, payloads: Iterator[bytes], seconds: float, hz: float) -> None:
    begin = time.monotonic()
    for number in range(round(seconds * hz)):
        time.sleep(max(0.0, begin + number / hz - time.monotonic()))
        publisher.publish(next(payloads))
    time.sleep(max(0.0, begin + seconds - time.monotonic()))


def _delivered(link: RobotLink) -> int:
    return sum(topic["delivered"] for topic in link.stats()["sink"]["topics"].values())
