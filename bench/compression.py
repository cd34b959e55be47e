"""Message compression: bytes per message, and processor time per message beside plain Python."""

from __future__ import annotations

import time
from statistics import mean

from bench.rows import Row
from bench.yardstick import Cost, cost
from gr_ros2.compression import LinkCodec
from gr_ros2.middleware.bag_files import read_bag
from gr_ros2.settings.registry import Registry
from gr_ros2_lab.sim.fleet import Fleet
from gr_ros2_lab.sim.sim_settings import SimSettings
from tests.recordings import DRIVES

DRIVE = DRIVES[-1]
"""The recorded drive where it is, else that of the simulator."""
TWO_PACKETS = 102
"""Bytes of payload in two packets of 64 B."""
REPEATS = 9
MOST_TURNS = 1100
_TYPES = {"odom": "nav_msgs/msg/Odometry", "imu": "sensor_msgs/msg/Imu"}


def compression() -> list[Row]:
    """A recording, and the simulator; dictionaries were trained on neither."""
    odometry = [message.payload for message in read_bag(DRIVE.path, ["/robot_1/odom"])]
    imu = [message.payload for message in read_bag(DRIVE.path, ["/robot_1/imu"])]
    sizes = _sizes("odom", odometry)
    rows = [
        Row("compression: recorded odometry, mean of 724 B", mean(sizes), "B", "≤", 85, "{:,.1f}", DRIVE.path.name),
        Row("compression: recorded odometry, 99 %", _p99(sizes), "B", "≤", TWO_PACKETS, note=_one_packet(sizes)),
        Row("compression: recorded imu, mean of 324 B", mean(_sizes("imu", imu)), "B", "≤", 110, "{:,.1f}"),
    ]
    settings = SimSettings(robots=1, seed=7, prefix_frames=True)
    simulated = [m.payload for m in Fleet(settings).messages(30.0, 1.7e9) if m.topic.endswith("/odom")]
    sizes = _sizes("odom", simulated)
    what, took = "compression: encode + decode of an odometry", _cost(simulated)
    return [
        *rows,
        Row("compression: simulated odometry, 99 %", _p99(sizes), "B", "≤", TWO_PACKETS, note=_one_packet(sizes)),
        Row(f"{what}, over a turn of plain Python", took.turns, "", "≤", MOST_TURNS, "{:.0f}", took.note),
    ]


def _sizes(topic: str, payloads: list[bytes]) -> list[int]:
    codec = LinkCodec(Registry.from_rows({topic: _TYPES[topic]}))
    return sorted(len(codec.encode(0, payload)) for payload in payloads)


def _p99(sizes: list[int]) -> int:
    return sizes[int(0.99 * len(sizes))]


def _one_packet(sizes: list[int]) -> str:
    return f"{sum(size <= TWO_PACKETS // 2 for size in sizes) / len(sizes):.1%} fit one packet of 64 B"


def _cost(payloads: list[bytes]) -> Cost:
    codec = LinkCodec(Registry.from_rows({"odom": _TYPES["odom"]}))

    def each() -> float:
        begin = time.thread_time()
        for payload in payloads:
            codec.decode(0, codec.encode(0, payload))
        return (time.thread_time() - begin) / len(payloads)

    return cost(REPEATS, each)
