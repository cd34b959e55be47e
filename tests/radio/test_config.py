"""One YAML file tells a link everything, and a wrong one is said in a line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from gr_ros2.core.errors import ConfigError
from gr_ros2.middleware import Qos
from gr_ros2.middleware.memory import MemoryMiddleware
from gr_ros2.phy import PHY
from gr_ros2.radio import FRONT_ENDS
from gr_ros2.radio.config import EXAMPLES_DIR, LinkConfig, link_from, load_link
from gr_ros2.settings.config import build
from gr_ros2.settings.registry import Registry
from tests.domains import domain

EXAMPLES = sorted(EXAMPLES_DIR.glob("link-*.yaml"))
SMALL: dict[str, Any] = {
    "registry": "topics.csv",
    "robot": 1,
    "phy": {"name": "psk", "sample_rate": 1e6},
}


def test_every_front_end_has_an_example() -> None:
    assert {load_link(path).front_end_name for path in EXAMPLES} == set(FRONT_ENDS.own)


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_examples_hold_no_wrong_setting(path: Path) -> None:
    pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")
    config = load_link(path)
    assert len(Registry.from_csv(config.registry)) > 0
    phy = PHY.load(config.phy.name)(config.packet_len, config.phy.sample_rate, **config.phy.options)
    phy.check_channel(config.channel)
    build(FRONT_ENDS.load(config.front_end_name).Options, config.front_end_options)


def test_a_robot_has_a_number_and_a_name() -> None:
    config = link_from({**SMALL, "robot": "/robot_7"})
    assert (config.robot_id, config.namespace) == (7, "/robot_7")
    assert link_from(SMALL).namespace == "/robot_1"
    named = link_from({**SMALL, "robot": "3", "graph": {"namespace": "/alice"}})
    assert (named.robot_id, named.namespace) == (3, "/alice")
    assert config.front_end == {"name": "sim"}


def test_what_is_sent_is_words_a_list_or_a_mapping() -> None:
    given = ["auto, -camera/*", ["auto", "-camera/*"], {"auto": None, "-camera/*": {}}]
    assert len({tuple(link_from({**SMALL, "topics": topics}).topics) for topics in given}) == 1
    assert list(link_from(SMALL).topics) == ["auto"]
    limited = link_from({**SMALL, "topics": {"auto": None, "odom": {"max_rate": 10}}})
    assert [(word, options.max_rate) for word, options in limited.topics.items()] == [("auto", 0), ("odom", 10)]
    assert not link_from({**SMALL, "topics": []}).sends
    assert not link_from({**SMALL, "direction": "receive"}).sends


def test_the_depths_of_a_graph_are_those_of_its_blocks() -> None:
    pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")
    from tests.gr.ends import link

    depths: list[int] = []

    class Told(MemoryMiddleware):
        def subscribe(self, topic: str, type_name: str, qos: Qos, callback: Any) -> Any:
            depths.append(qos.depth)
            return super().subscribe(topic, type_name, qos, callback)

        def advertise(self, topic: str, type_name: str, qos: Qos) -> Any:
            depths.append(qos.depth)
            return super().advertise(topic, type_name, qos)

    rows = Registry.from_rows({"odom": "nav_msgs/Odometry"})
    with Told(domain_id=domain(1)) as graph:
        one = link(robot=1, graph_depth=7, publish_depth=3, registry=rows, middleware=graph)
        one.sink.outputs.announce(2, [0])
        one.close()
    assert depths == [7, 3]


def test_options_of_one_topic_leave_the_choice_of_topics(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("{robot: 1, phy: {name: direct}}")
    assert list(load_link(path, ["topics.odom.max_rate=5"]).topics) == ["auto", "odom"]
    assert load_link(path, ["topics=[odom, scan]", "topics.odom.max_rate=5"]).topics["odom"].max_rate == 5


def test_settings_are_replaced_one_by_one(tmp_path: Path) -> None:
    (tmp_path / "mine.csv").write_text("odom,nav_msgs/Odometry\n")
    path = tmp_path / "mine.yaml"
    path.write_text("{registry: mine.csv, robot: 1, phy: {name: psk, sample_rate: 1e6}}")
    config = load_link(path, ["front_end.guard_s=2e-3", "phy.sample_rate=5e5", "front_end.name=sim"])
    assert (config.name, config.phy.sample_rate) == ("mine", 5e5)
    assert config.registry == str(tmp_path / "mine.csv")
    assert config.front_end_options == {"guard_s": 0.002}


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"frequency": 1e6}, "unknown key frequency"),
        ({"packet_len": 5}, "packet_len = 5"),
        ({"version": 0}, "version is no setting any more: a link speaks version 1"),
        ({"packet_len": 13}, "packet_len = 13: [^;]*$"),
        ({"phy": 5}, r"phy = 5: must be keys and values \(which physical layer"),
        ({"robot": "/alice"}, "robot = '/alice': the name has no digits; write the robot's number"),
        ({"robot": "/robot_255"}, "robot = '/robot_255': 255 is not below 255"),
        ({"robot": 255}, "robot = 255: must be less than or equal to 254"),
        ({"ros_source": {"namespace": "/robot_1"}}, "ros_source is no setting any more: write robot, topics and graph"),
        ({"graph": {"namespace_format": "x"}}, "graph.namespace_format is no setting any more: write publish.as"),
        ({"topics": {"-odom": {"max_rate": 1}}}, "topics.*'-odom' leaves topics out, which have no options"),
        ({"topics": {"odom": {"queue": "first"}}}, "topics.odom.queue = 'first': must be 'latest'"),
        ({"publish": {"merge_tf": "/tf"}}, "publish.merge_tf = '/tf': frames of several robots"),
        ({"beacon_s": 5, "direction": "send"}, "beacon_s = 5.0: who hears nobody would fall silent for ever"),
        ({"graph": {"middleware": "dsd"}}, "graph.middleware = 'dsd'.*known are"),
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


def test_without_a_registry_nothing_is_registered() -> None:
    assert LinkConfig(**{**SMALL, "registry": "x"}).name == "link"
