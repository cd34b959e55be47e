"""A real robot's recording over the OFDM loopback: each delivered message is identical to the recorded one."""

from __future__ import annotations

from pathlib import Path

import pytest

from gr_ros2.middleware import Qos
from gr_ros2.middleware.bag import BagMiddleware, BagPublisher
from gr_ros2.middleware.bag_files import BagMessage, read_bag
from gr_ros2.run.runner import run_scenario
from gr_ros2.run.scenario import load_scenario
from tests.e2e.support import HUSKY, check_complete, check_identical, delivered_bag, needs_husky, on_free_domains

TOPICS = {"odom": "nav_msgs/Odometry", "imu": "sensor_msgs/Imu", "fix": "sensor_msgs/NavSatFix"}
SLICE_S = 20.0


@pytest.fixture
def recording(tmp_path: Path) -> tuple[Path, list[BagMessage]]:
    """The first 20 s of the Husky's drive as a bag of its own."""
    path = tmp_path / "slice"
    messages = list(read_bag(HUSKY, [f"/robot_1/{name}" for name in TOPICS]))
    messages = [one for one in messages if one.stamp_ns - messages[0].stamp_ns < SLICE_S * 1e9]
    with BagMiddleware(path=path, mode="write") as bag:
        publishers = {
            f"/robot_1/{name}": bag.advertise(f"/robot_1/{name}", kind, Qos()) for name, kind in TOPICS.items()
        }
        for one in messages:
            publisher = publishers[one.topic]
            assert isinstance(publisher, BagPublisher)
            publisher.publish_at(one.payload, one.stamp_ns)
    return path, messages


@pytest.mark.real_time
@needs_husky
def test_a_recorded_drive_crosses_the_ofdm_link_completely(
    tmp_path: Path, recording: tuple[Path, list[BagMessage]]
) -> None:
    bag, messages = recording
    registry = tmp_path / "husky.csv"
    registry.write_text("".join(f"{name},{kind}\n" for name, kind in TOPICS.items()))
    settings = [
        f"registry={registry}",
        f"source=bag:{bag}",
        "bag_speed=0",
        "pace=flow",
        "duration_s=0",
        "phy.name=ofdm",
        "phy.sample_rate=1e6",
        "packet_len=220",
        "ros_source.queue_depth=100",
        "paced=true",
        "drain_s=5",
        *on_free_domains(),
    ]
    out = tmp_path / "out"
    check_complete(run_scenario(load_scenario("paper-ofdm", settings), out).result)
    for name in TOPICS:
        sent = [one.payload for one in messages if one.topic == f"/robot_1/{name}"]
        assert len(sent) > 40
        check_identical(delivered_bag(out, f"/rx_robot_1/{name}"), sent)
