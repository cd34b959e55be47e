"""The sizes asked for, on data that no dictionary was trained on."""

from __future__ import annotations

from statistics import mean

import pytest

from tests.compression.support import codec_for, husky, simulated

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


def test_recorded_odometry() -> None:
    found = sizes("nav_msgs/Odometry", husky("/robot_1/odom"))
    assert mean(found) <= 51
    assert found[int(0.99 * len(found))] <= 51  # one packet of 64 B; two were asked for


def test_recorded_imu_and_fix() -> None:
    assert mean(sizes("sensor_msgs/Imu", husky("/robot_1/imu"))) <= 80
    assert mean(sizes("sensor_msgs/NavSatFix", husky("/robot_1/fix"))) <= 40


@pytest.mark.parametrize(
    "settings", [{}, {"prefix_frames": True, "seed": 7}, {"odom_linear_noise": 0.0331, "odom_angular_noise": 0.0173}]
)
def test_simulated_odometry_with_noise_in_all_its_doubles(settings: dict[str, float]) -> None:
    found = sizes("nav_msgs/Odometry", simulated("odom", 20.0, **settings))
    assert found[int(0.99 * len(found))] <= TWO_PACKETS * 0.6
