"""Names by ROS's rules, wherever they come in."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gr_ros2.core.errors import ConfigError
from gr_ros2.core.names import MAX_TOPIC_LEN, check_node, check_topic, filled, topic_fault
from gr_ros2.gr.ros_link import make_link
from gr_ros2.radio.config import link_from
from gr_ros2.settings.config import build
from gr_ros2.settings.registry import Registry, check_outputs
from gr_ros2.settings.robot import GraphConfig, PublishConfig, PublishOptions
from gr_ros2_lab.run.scenario import load_scenario, scenario_from

NAMES = st.text(st.sampled_from("aZ_09/-~ {}é\n"), max_size=12)
REGISTRY = Registry.from_rows({"odom": "nav_msgs/Odometry", "tf": "tf2_msgs/TFMessage"})


@given(NAMES)
def test_a_topic_is_parts_of_letters_digits_and_underscores_behind_slashes(name: str) -> None:
    assert (topic_fault(name) == "") == bool(re.fullmatch(r"(/[A-Za-z_][A-Za-z0-9_]*)+", name, re.ASCII))


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("", "begin with /"),
        ("odom", "begin with /"),
        ("/", "not end with /"),
        ("/odom/", "not end with /"),
        ("/a//b", "two / in a row"),
        ("/robot-1/odom", "'-' may not stand"),
        ("/a b/odom", "' ' may not stand"),
        ("/~/odom", "'~' may not stand"),
        ("/r/1st/odom", "part '1st' must not begin with a digit"),
        ("/" + "a" * MAX_TOPIC_LEN, f"{MAX_TOPIC_LEN + 1} characters, ROS allows {MAX_TOPIC_LEN}"),
    ],
)
def test_what_is_wrong_with_a_topic_is_said(name: str, says: str) -> None:
    assert says in topic_fault(name)
    with pytest.raises(ConfigError, match=re.escape(repr(name))):
        check_topic(name)


def test_the_longest_topic_passes() -> None:
    assert check_topic("/" + "a" * (MAX_TOPIC_LEN - 1))


@pytest.mark.parametrize("namespace", ["", "/", "robot_1", "/robot_1", "/robot_1/", "/fleet/robot_1"])
def test_a_namespace_may_be_written_as_people_do(namespace: str) -> None:
    assert GraphConfig(namespace=namespace).namespace == namespace
    assert check_node("n", namespace) == ("n", "/" + namespace.strip("/"))


@pytest.mark.parametrize("namespace", ["/robot-1", "/robot 1", "//robot_1", "/robot_1//", "/1", "~", "/{robot}"])
def test_a_namespace_that_ros_refuses(namespace: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(f"namespace = {namespace!r}: ")):
        build(GraphConfig, {"namespace": namespace})
    with pytest.raises(ConfigError, match=re.escape(f"namespace {namespace!r}: ")):
        check_node("n", namespace)


@pytest.mark.parametrize("name", ["", "1st", "a-b", "a/b", "a" * 256])
def test_a_node_name_that_ros_refuses(name: str) -> None:
    with pytest.raises(ConfigError, match="node_name"):
        check_node(name, "/")


@pytest.mark.parametrize("key", ["as", "frame_prefix"])
@pytest.mark.parametrize(
    "form", ["{robot.__class__}", "{robot!r}", "{robot:99}", "{robot}{", "{{robot}}", "{who}", "{}", "{0}"]
)
def test_a_form_has_one_field(key: str, form: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(f"{key} = '/x{form}'" if key == "as" else f"{key} = 'x{form}'")):
        build(PublishConfig, {key: f"/x{form}" if key == "as" else f"x{form}"})
    with pytest.raises(ConfigError, match="as = "):
        build(PublishOptions, {"as": f"/x{form}"})


@given(st.sampled_from(["/rx_robot_{robot}", "rx_{robot}_{robot}/", "/", "", "/all"]), st.integers(0, 255))
def test_a_form_that_passes_gives_every_sender_a_name_ros_takes(form: str, src_id: int) -> None:
    publish = build(PublishConfig, {"as": form})
    name = REGISTRY[0].republished(publish.as_, src_id)
    assert check_topic(name) == name
    assert filled(form, src_id) == form.format(robot=src_id)


@pytest.mark.parametrize(
    ("key", "value", "says"),
    [
        ("as", "/rx-{robot}", "'-' may not stand"),
        ("as", "/a b/{robot}", "' ' may not stand"),
        ("as", "/{robot}", "part '255' must not begin with a digit (for sender 255)"),
        ("as", "/rx//{robot}", "two / in a row"),
        ("frame_prefix", "/robot_{robot}/", "must not begin with /"),
        ("frame_prefix", "robot\0", "cannot be printed"),
        ("merge_tf", "tf", "must begin with /"),
        ("merge_tf", "/all-tf", "'-' may not stand"),
        ("merge_tf", "/" + "t" * 240, "241 characters, ROS allows 240"),
    ],
)
def test_a_sink_refuses_names_that_ros_does(key: str, value: str, says: str) -> None:
    with pytest.raises(ConfigError, match=f"{re.escape(f'{key} = {value!r}: ')}.*{re.escape(says)}"):
        build(PublishConfig, {"frame_prefix": "robot_{robot}/", key: value})


@pytest.mark.parametrize("value", ["/robot-1/odom", "/a b/odom", "/odom/", "/", "/1/odom", "{robot}"])
def test_a_topic_cannot_come_out_under_a_name_that_ros_refuses(value: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(f"topics.odom.as = {value!r}: ")):
        build(PublishConfig, {"topics": {"odom": {"as": value}}})


def test_a_link_and_a_scenario_refuse_them_when_they_are_read() -> None:
    link = {"registry": "r.csv", "phy": {"name": "direct"}, "robot": 1}
    for values, key in (
        ({"publish": {"as": "/rx-{robot}"}}, "publish.as"),
        ({"graph": {"namespace": "/robot-1"}}, "graph.namespace"),
        ({"publish": {"topics": {"odom": {"as": "/robot-1/odom"}}}}, "publish.topics.odom.as"),
    ):
        with pytest.raises(ConfigError, match=re.escape(key)):
            link_from({**link, **values})
        with pytest.raises(ConfigError, match=re.escape(key)):
            scenario_from({"name": "x", "registry": "r.csv", "robots": 2, **values})
    with pytest.raises(ConfigError, match=r"publish\.as"):
        load_scenario("demo", ["publish.as=/rx-{robot}"])


def test_names_of_a_registry_and_of_what_comes_out_together() -> None:
    check_outputs(REGISTRY, PublishConfig(frame_prefix="r{robot}/", merge_tf="/tf"))
    long = Registry.from_rows({"a" * 240: "nav_msgs/Odometry"})
    with pytest.raises(ConfigError, match=r"ROS allows 247; change its publish_as, or publish\.as"):
        check_outputs(long, PublishConfig())
    shared: dict[str, Any] = {"odom": {"as": "/x"}, "tf": {"as": "/x"}}
    with pytest.raises(ConfigError, match="'tf' would come out as '/x' of type tf2_msgs/msg/TFMessage, where nav_msgs"):
        check_outputs(REGISTRY, build(PublishConfig, {"topics": shared}))
    with pytest.raises(ConfigError, match="'odom' would come out as '/tf' of type nav_msgs/msg/Odometry"):
        check_outputs(
            REGISTRY,
            build(PublishConfig, {"frame_prefix": "r{robot}/", "merge_tf": "/tf", "topics": {"odom": {"as": "/tf"}}}),
        )


def test_a_scenario_refuses_them_with_its_registry(tmp_path: Path) -> None:
    registry = tmp_path / "r.csv"
    registry.write_text(f"odom,nav_msgs/Odometry\n{'a' * 240},nav_msgs/Odometry\n")
    scenario = load_scenario("demo", registry=str(registry))
    with pytest.raises(ConfigError, match="ROS allows 247"):
        scenario.load_registry()
    with pytest.raises(ConfigError, match="ROS allows 247"):
        make_link(registry=str(registry), robot=1, graph_middleware="memory", state=str(tmp_path / "state"))
