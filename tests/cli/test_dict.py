"""`gr-ros2 dict`: train on a recording, list what there is."""

from __future__ import annotations

from pathlib import Path

import pytest
from click.testing import CliRunner
from rosbags.rosbag2 import StoragePlugin, Writer

from gr_ros2.cli.dict import group
from gr_ros2.compression import load
from gr_ros2.core.errors import BagError, ConfigError
from tests.compression.support import STORE, codec_for, simulated

ODOMETRY = "nav_msgs/msg/Odometry"


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    path = tmp_path / "bag"
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection("/odom", ODOMETRY, typestore=STORE)
        for n, payload in enumerate(simulated("odom", 3.0, odom_linear_noise=0.0331)):
            writer.write(connection, n * 10**8, payload)
        lonely = writer.add_connection("/map", "std_msgs/msg/String", typestore=STORE)
        writer.write(lonely, 0, b"\0\1\0\0\2\0\0\0a\0")
    return path


def test_train_writes_a_dictionary_that_pays(bag: Path, tmp_path: Path) -> None:
    out = tmp_path / "mine.json"
    result = CliRunner().invoke(group, ["train", str(bag), "--out", str(out)], catch_exceptions=False)
    made = load(out)
    assert f"id {made.digest[:4]}" in result.output
    assert "left out, fewer than 8 messages: /map" in result.output
    payload = simulated("odom", 0.2, odom_linear_noise=0.0331)[0]
    assert len(codec_for(ODOMETRY, made).encode(0, payload)) < len(codec_for(ODOMETRY).encode(0, payload))


def test_list_shows_the_shipped_and_given_ones(bag: Path, tmp_path: Path) -> None:
    assert "sensor_msgs/msg/Imu" in CliRunner().invoke(group, ["list"]).output
    out = tmp_path / "mine.json"
    CliRunner().invoke(group, ["train", str(bag), "--topics", "odom", "--out", str(out)], catch_exceptions=False)
    listed = CliRunner().invoke(group, ["list", str(out)]).output
    assert ODOMETRY in listed
    assert "sensor_msgs/msg/Imu" not in listed


def test_errors_name_the_bag_and_the_topic(bag: Path, tmp_path: Path) -> None:
    for arguments, error, text in (
        ([str(tmp_path / "none"), "--out", "x"], BagError, "none"),
        ([str(bag), "--out", "x", "--topics", "imu"], ConfigError, "'/imu'"),
        ([str(bag), "--out", "x", "--topics", "map"], ConfigError, "at least 8 messages"),
    ):
        result = CliRunner().invoke(group, ["train", *arguments])
        assert isinstance(result.exception, error)
        assert text in str(result.exception)
