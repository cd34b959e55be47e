"""One YAML file tells a link everything, and a wrong one is said in a line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from gr_ros2.core.errors import ConfigError
from gr_ros2.phy import PHY
from gr_ros2.radio import FRONT_ENDS
from gr_ros2.radio.config import EXAMPLES_DIR, LinkConfig, link_from, load_link
from gr_ros2.settings.config import build

EXAMPLES = sorted(EXAMPLES_DIR.glob("link-*.yaml"))
SMALL: dict[str, Any] = {
    "registry": "topics.csv",
    "ros_source": {"robot_id": 1},
    "phy": {"name": "psk", "sample_rate": 1e6},
}


def test_every_front_end_has_an_example() -> None:
    assert {load_link(path).front_end_name for path in EXAMPLES} == set(FRONT_ENDS.own)


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_examples_hold_no_wrong_setting(path: Path) -> None:
    pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")
    config = load_link(path)
    assert len(config.load_registry()) > 0
    phy = PHY.load(config.phy.name)(config.packet_len, config.phy.sample_rate, **config.phy.options)
    phy.check_channel(config.channel)
    build(FRONT_ENDS.load(config.front_end_name).Options, config.front_end_options)


def test_both_blocks_follow_the_top_level() -> None:
    config = link_from({**SMALL, "packet_len": 100})
    assert (config.ros_source.packet_len, config.ros_sink.packet_len) == (100, 100)
    assert config.ros_source.registry == config.ros_sink.registry == "topics.csv"
    assert config.front_end == {"name": "sim"}


def test_settings_are_replaced_one_by_one(tmp_path: Path) -> None:
    (tmp_path / "mine.csv").write_text("odom,nav_msgs/Odometry\n")
    path = tmp_path / "mine.yaml"
    path.write_text("{registry: mine.csv, ros_source: {robot_id: 1}, phy: {name: psk, sample_rate: 1e6}}")
    config = load_link(path, ["front_end.guard_s=2e-3", "phy.sample_rate=5e5", "front_end.name=sim"])
    assert (config.name, config.phy.sample_rate) == ("mine", 5e5)
    assert config.registry == str(tmp_path / "mine.csv")
    assert config.front_end_options == {"guard_s": 0.002}


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"frequency": 1e6}, "unknown key frequency"),
        ({"packet_len": 5}, "packet_len = 5"),
        ({"registry": "", "version": 0}, "registry is missing"),
        ({"packet_len": 13}, "packet_len = 13: [^;]*$"),
        ({"phy": 5}, r"phy = 5: must be keys and values \(which physical layer"),
        ({"ros_source": {}}, "robot_id = auto"),
        ({"ros_source": {"robot_id": 1, "packet_len": 99}}, "ros_source.packet_len = 99: both ends share it"),
        ({"ros_sink": {"middleware": "dsd"}}, "ros_sink.middleware = 'dsd'.*known are"),
        ({"phy": {"name": "psk"}}, "phy.sample_rate = auto: a link needs one"),
        ({"phy": {"name": "fm", "sample_rate": 1e6}}, "phy.name = 'fm'.*known are"),
        ({"front_end": {}}, "front_end.name is missing; known are sim, zmq"),
        ({"front_end": {"name": "rtl"}}, "front_end.name = 'rtl'.*known are"),
        ({"front_end": "sim"}, "front_end"),
        ({"channel": {"snr_db": 900}}, "channel.snr_db = 900"),
    ],
)
def test_a_wrong_setting_is_named(change: dict[str, Any], said: str) -> None:
    with pytest.raises(ConfigError, match=f"robot.yaml: .*{said}"):
        link_from({**SMALL, **change}, "robot.yaml")


def test_a_missing_file_is_named() -> None:
    with pytest.raises(ConfigError, match=r"nowhere.yaml.*no such file; examples lie in"):
        load_link("nowhere.yaml")


def test_with_version_0_a_link_needs_a_registry() -> None:
    with pytest.raises(ConfigError, match="registry is missing"):
        link_from({**{key: value for key, value in SMALL.items() if key != "registry"}, "version": 0})
    assert not link_from({key: value for key, value in SMALL.items() if key != "registry"}).load_registry()
    assert LinkConfig(**{**SMALL, "registry": "x"}).name == "link"
