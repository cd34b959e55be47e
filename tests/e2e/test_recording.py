"""A robot's recording over the OFDM loopback: each delivered message is identical to the recorded one."""

from __future__ import annotations

from pathlib import Path

import pytest

from gr_ros2.middleware import Qos
from gr_ros2.middleware.bag import BagMiddleware, BagPublisher
from gr_ros2.middleware.bag_files import BagMessage, read_bag
from gr_ros2_lab.run.runner import run_scenario
from gr_ros2_lab.run.scenario import load_scenario
from tests.e2e.support import check_complete, check_identical, delivered_bag, on_free_domains
from tests.recordings import Drive, every_drive

SLICE_S = 10.0


def first_part(drive: Drive, path: Path) -> list[BagMessage]:
    """The first seconds of a drive as a bag of its own."""
    messages = list(read_bag(drive.path, drive.names))
    messages = [one for one in messages if one.stamp_ns - messages[0].stamp_ns < SLICE_S * 1e9]
    with BagMiddleware(path=path, mode="write") as bag:
        publishers = {
            name: bag.advertise(name, kind, Qos())
            for name, kind in zip(drive.names, drive.topics.values(), strict=True)
        }
        for one in messages:
            publisher = publishers[one.topic]
            assert isinstance(publisher, BagPublisher)
            publisher.publish_at(one.payload, one.stamp_ns)
    return messages


@pytest.mark.slow
@pytest.mark.real_time
@every_drive
def test_a_recorded_drive_crosses_the_ofdm_link_completely(tmp_path: Path, drive: Drive) -> None:
    bag = tmp_path / "slice"
    messages = first_part(drive, bag)
    registry = drive.write_registry(tmp_path / "drive.csv")
    settings = [
        f"registry={registry}",
        f"source=bag:{bag}",
        "bag_speed=0",
        "duration_s=0",
        "phy.name=ofdm",
        "phy.sample_rate=1e6",
        "packet_len=220",
        "queue_depth=100",
        "packet_rate=auto",
        "drain_s=60",  # of a computer that falls behind the radio
        *on_free_domains(),
    ]
    out = tmp_path / "out"
    check_complete(run_scenario(load_scenario("paper-ofdm", settings), out).result)
    for name in drive.topics:
        sent = [one.payload for one in messages if one.topic == f"/robot_1/{name}"]
        assert len(sent) > 20
        check_identical(delivered_bag(out, f"/rx_robot_1/{name}"), sent)
