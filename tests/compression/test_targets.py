"""The sizes asked for, on data that no dictionary was trained on."""

from __future__ import annotations

from statistics import mean

import pytest

from gr_ros2.middleware.bag_files import read_bag
from tests.compression.support import codec_for, simulated
from tests.recordings import Drive, every_drive

TWO_PACKETS = 102
"""Bytes of payload in two packets of 64 B."""


def sizes(type_name: str, payloads: list[bytes]) -> list[int]:
    codec = codec_for(type_name)
    out = []
    for payload in payloads:
        coded = codec.encode(0, payload)
        assert codec.decode(0, coded) == payload
        out.append(len(coded))
    return sorted(out)


def payloads(drive: Drive, name: str) -> list[bytes]:
    return [message.payload for message in read_bag(drive.path, [f"/robot_1/{name}"])]


@every_drive
def test_recorded_odometry(drive: Drive) -> None:
    found = sizes("nav_msgs/Odometry", payloads(drive, "odom"))
    assert mean(found) <= 51
    assert found[int(0.99 * len(found))] <= 51  # one packet of 64 B; two were asked for


LARGEST = {"imu": 80, "fix": 40, "scan": 200}
"""Mean bytes of a message."""


@every_drive
def test_recorded_sensors(drive: Drive) -> None:
    names = set(drive.topics) & set(LARGEST)
    assert len(names) == 2
    for name in names:
        assert mean(sizes(drive.topics[name], payloads(drive, name))) <= LARGEST[name], name


@pytest.mark.parametrize("settings", [{}, {"prefix_frames": True, "seed": 7}, {"odom_noise": (0.0331, 0.0173)}])
def test_simulated_odometry_with_noise_in_all_its_doubles(settings: dict[str, float]) -> None:
    found = sizes("nav_msgs/Odometry", simulated("odom", 20.0, **settings))
    assert found[int(0.99 * len(found))] <= TWO_PACKETS * 0.6
