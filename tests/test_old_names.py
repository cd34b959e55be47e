"""Settings under the names and values they had once: one line that says what to write now."""

from __future__ import annotations

from typing import Any

import pytest

from gr_ros2.config import SinkConfig, SourceConfig, TopicOptions, build
from gr_ros2.errors import ConfigError
from gr_ros2.old_names import OLD_NAMES, new_name
from gr_ros2.radio.config import LinkConfig, link_from
from gr_ros2.registry import Registry
from gr_ros2.run.scenario import Scenario, scenario_from

SCENARIO = {"name": "old", "registry": "table4.csv", "ros_source": {"namespace": "/robot_1"}}
ADDRESSES = {"zmq": {"bind": "ipc:///tmp/a", "connect": ["ipc:///tmp/b"]}}
LINK = {**SCENARIO, "phy": {"name": "direct"}}


def complaint(cls: type[Any], values: dict[str, Any]) -> str:
    with pytest.raises(ConfigError) as caught:
        {Scenario: scenario_from, LinkConfig: link_from}.get(cls, lambda values: build(cls, values))(values)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize(
    ("cls", "values", "says"),
    [
        (SourceConfig, {"flush_timeout": 1}, "unknown key flush_timeout: write flush_timeout_s"),
        (SinkConfig, {"reassembly_timeout": 5}, "unknown key reassembly_timeout: write reassembly_timeout_s"),
        (TopicOptions, {"deadline_ms": 100}, "unknown key deadline_ms: write deadline_s, in seconds"),
        (
            SourceConfig,
            {"topic_options": {"odom": {"deadline_ms": 100}}},
            "unknown key topic_options.odom.deadline_ms: write deadline_s, in seconds",
        ),
        (Scenario, {**SCENARIO, "sim": {"start_time": 3}}, "unknown key sim.start_time: write start_time_s"),
        (Scenario, {**SCENARIO, "pace": "flow"}, "unknown key pace: write time: unthrottled for pace: flow"),
        (Scenario, {**SCENARIO, "paced": False}, "unknown key paced: write ros_source.packet_rate: 0 for paced: false"),
    ],
)
def test_an_old_name_is_answered_with_the_new_one(cls: type[Any], values: dict[str, Any], says: str) -> None:
    assert says in complaint(cls, values)


def test_every_old_name_is_in_the_table_of_the_class_it_stood_in() -> None:
    for old, (field, said) in OLD_NAMES.items():
        assert new_name(old, (field, "other")) == said
        assert new_name(old, ("other",)) == ""
    assert new_name("colour", ("colour_of_hair",)) == ""


@pytest.mark.parametrize(("name", "values"), [("zmq", {"queue": 3}), ("sim", {"guard": 1})])
def test_a_front_ends_old_names(name: str, values: dict[str, Any]) -> None:
    pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")
    from gr_ros2.radio import FRONT_ENDS

    (old,) = values
    said = complaint(FRONT_ENDS.load(name).Options, {**ADDRESSES.get(name, {}), **values})
    assert said == f"unknown key {old}: write {OLD_NAMES[old][1]}"


def test_a_registry_with_an_old_column(tmp_path: Any) -> None:
    path = tmp_path / "old.csv"
    path.write_text("topic,type,deadline_ms\nodom,nav_msgs/Odometry,100\n")
    with pytest.raises(ConfigError, match="'deadline_ms'; write deadline_s, in seconds"):
        Registry.from_csv(path)


@pytest.mark.parametrize(
    ("cls", "values", "key"),
    [
        (SourceConfig, {"robot_id": -1}, "robot_id = -1"),
        (SinkConfig, {"domain_id": -1}, "domain_id = -1"),
        (TopicOptions, {"queue": None}, "queue = None"),
        (TopicOptions, {"publish_as": ""}, "publish_as = ''"),
        (Scenario, {**SCENARIO, "phy": {"sample_rate": 0}}, "phy.sample_rate = 0"),
        (LinkConfig, {**LINK, "localhost_only": None}, "localhost_only = None"),
    ],
)
def test_what_stood_for_auto_once_is_answered_with_auto(cls: type[Any], values: dict[str, Any], key: str) -> None:
    assert f"{key}: write auto" in complaint(cls, values)
