"""Every setting: unknown keys, ranges, cross-field rules, and what the errors say."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gr_ros2.core.errors import ConfigError
from gr_ros2.paper.settings import PaperConfig, paper_from
from gr_ros2.radio.config import link_from
from gr_ros2.settings.config import (
    BurstLoss,
    ChannelConfig,
    PhyConfig,
    SendOptions,
    airtime_from,
    build,
    read_yaml,
)
from gr_ros2.settings.robot import GraphConfig, PublishConfig, PublishOptions, RobotConfig, number_of, robot_from
from gr_ros2_lab.run.scenario import scenario_from

CONFIGS = (SendOptions, PublishOptions, PaperConfig, GraphConfig, PublishConfig, ChannelConfig, PhyConfig)


NEEDED = {RobotConfig: {"robot": 1}}


def refused(cls: type[Any], where: str = "", **values: Any) -> str:
    with pytest.raises(ConfigError) as caught:
        build(cls, values, where)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("cls", CONFIGS)
def test_defaults_are_valid(cls: type[Any]) -> None:
    assert build(cls, {}) == cls()


def test_the_defaults_are_the_designs() -> None:
    robot, paper = RobotConfig(robot="/robot_1"), PaperConfig()
    assert (paper.min_fragment, paper.greedy, paper.flush_timeout_s, paper.hop) == (16, False, 0.0, 1)
    assert (paper.dst_id, paper.entry_ids, paper.reassembly_timeout_s) == (255, "sequential", 1.0)
    assert (robot.robot_id, robot.namespace, robot.packet_len, robot.packet_rate) == (1, "/robot_1", 220, "auto")
    assert (robot.graph.middleware, robot.graph.depth, robot.repeat_s, robot.max_sources) == ("dds", 10, 10.0, 16)
    assert (robot.publish.as_, robot.publish.depth) == ("/rx_robot_{robot}", 10)


@pytest.mark.parametrize("cls", CONFIGS)
def test_an_unknown_key_names_the_known_ones(cls: type[Any]) -> None:
    error = refused(cls, "robots.yaml", colour="red")
    assert error.startswith("robots.yaml: unknown key colour; known are ")
    assert all(field.name.removesuffix("_") in error for field in fields(cls))


def test_an_unknown_key_further_down_is_named_with_its_path() -> None:
    error = refused(RobotConfig, robot=1, topics={"odom": {"priority": 3}})
    assert "unknown key topics.odom.priority" in error


@pytest.mark.parametrize(
    ("cls", "key", "value"),
    [
        (RobotConfig, "packet_len", 13),
        (RobotConfig, "packet_len", 4096),
        (RobotConfig, "robot", -2),
        (RobotConfig, "robot", 255),
        (PaperConfig, "dst_id", 256),
        (PaperConfig, "hop", 16),
        (PaperConfig, "hop", -1),
        (PaperConfig, "min_fragment", 0),
        (PaperConfig, "flush_timeout_s", -0.1),
        (PaperConfig, "flush_timeout_s", float("nan")),
        (RobotConfig, "repeat_s", 1e300),
        (RobotConfig, "packet_rate", float("inf")),
        (RobotConfig, "queue_depth", -1),
        (GraphConfig, "depth", -1),
        (PaperConfig, "entry_ids", "backwards"),
        (GraphConfig, "domain_id", 233),
        (PaperConfig, "greedy", "perhaps"),
        (PaperConfig, "reassembly_timeout_s", 0),
        (RobotConfig, "max_sources", 0),
        (RobotConfig, "max_source_bytes", 100),
        (PublishConfig, "depth", 1.5),
        (ChannelConfig, "packet_loss", 1.01),
        (ChannelConfig, "snr_db", float("nan")),
        (ChannelConfig, "frequency_offset", 0.6),
        (ChannelConfig, "epsilon", 1.1),
        (PhyConfig, "headroom", 0),
        (PhyConfig, "sample_rate", -1),
        (SendOptions, "qos", "urgent"),
        (SendOptions, "durability", "eternal"),
        (SendOptions, "depth", -1),
        (SendOptions, "queue_depth", 1 << 64),
        (PublishConfig, "depth", 10**30),
    ],
)
def test_out_of_range_names_key_and_value(cls: type[Any], key: str, value: Any) -> None:
    error = refused(cls, **NEEDED.get(cls, {}) | {key: value})
    assert error.startswith(f"{key} = {value!r}: ")
    assert len(error) > len(f"{key} = {value!r}: ") + 5


@pytest.mark.parametrize(
    ("cls", "key", "low", "high"),
    [
        (RobotConfig, "packet_len", 14, 4095),
        (RobotConfig, "robot", 0, 254),
        (PaperConfig, "dst_id", 0, 255),
        (PaperConfig, "hop", 0, 15),
        (GraphConfig, "domain_id", 0, 232),
    ],
)
def test_the_ends_of_a_range_are_in_it(cls: type[Any], key: str, low: int, high: int) -> None:
    for value in (low, high):
        assert getattr(build(cls, NEEDED.get(cls, {}) | {key: value}), key) == value


@given(packet_len=st.integers(14, 4095), min_fragment=st.integers(1, 4200))
def test_min_fragment_must_fit_a_packet_of_one_entry(packet_len: int, min_fragment: int) -> None:
    values: dict[str, Any] = {"robot": 1, "packet_len": packet_len, "min_fragment": min_fragment}
    if min_fragment <= packet_len - 13:
        assert paper_from(**values)[1].min_fragment == min_fragment
    else:
        says = f"min_fragment = {min_fragment} does not fit packet_len = {packet_len}; at most {packet_len - 13}"
        with pytest.raises(ConfigError, match=says):
            paper_from(**values)


@pytest.mark.parametrize("text", ["/rx_{src}", "/rx_{}", "/rx_{robot", "/rx_}", "/rx_{0}"])
def test_only_the_robot_may_stand_in_braces(text: str) -> None:
    assert f"as = {text!r}: only {{robot}} may stand in braces" in refused(PublishConfig, **{"as": text})


@pytest.mark.parametrize(
    ("name", "number"),
    [("/robot_34/base", 34), ("/robot_1", 1), ("fleet7/robot_12", 12), ("/robot_007", 7), ("/r254", 254), ("/r0", 0)],
)
def test_the_number_is_the_last_run_of_digits(name: str, number: int) -> None:
    assert number_of(name) == number


@pytest.mark.parametrize(("name", "says"), [("", "has no digits"), ("/robot", "has no digits"), ("/r255", "255")])
def test_a_name_that_gives_no_number(name: str, says: str) -> None:
    assert says in refused(RobotConfig, robot=name)


def test_a_number_beside_a_namespace() -> None:
    robot = build(RobotConfig, {"robot": 9, "graph": {"namespace": "/robot_1"}})
    assert (robot.robot_id, robot.namespace) == (9, "/robot_1")


@pytest.mark.parametrize("text", ["off", "'off'"])
def test_repair_is_switched_off_with_and_without_quotes(tmp_path: Path, text: str) -> None:
    path = tmp_path / "source.yaml"
    path.write_text(f"{{robot: /robot_1, repair: {text}}}")
    assert build(RobotConfig, read_yaml(path)).repair == "off"


def test_several_errors_are_all_named() -> None:
    error = refused(PaperConfig, hop=99, dst_id=999, colour="red")
    assert all(part in error for part in ("hop = 99", "dst_id = 999", "unknown key colour"))


@pytest.mark.parametrize(
    ("cls", "values", "says"),
    [
        (RobotConfig, {"topics": 5}, "topics = 5: must be keys and values (what it sends: "),
        (PaperConfig, {"greedy": "perhaps"}, "greedy = 'perhaps': must be true or false (several entries"),
        (PaperConfig, {"hop": 1.5}, "hop = 1.5: must be a whole number (initial hop"),
        (PaperConfig, {"hop": 16}, "hop = 16: must be less than or equal to 15"),
        (RobotConfig, {"packet_rate": "fast"}, "packet_rate = 'fast': must be a number (packets/s"),
        (GraphConfig, {"namespace": 3}, "namespace = 3: must be a text"),
        (ChannelConfig, {"taps": []}, "taps = []: must have at least 1 item"),
        (ChannelConfig, {"burst_loss": 1}, "burst_loss = 1: must be keys and values (losses in bursts)"),
        (BurstLoss, {"p_good_to_bad": 0.1}, "p_bad_to_good is missing (the other way round, above 0..1)"),
    ],
)
def test_what_a_setting_must_be_is_said_in_plain_words(cls: type[Any], values: dict[str, Any], says: str) -> None:
    assert refused(cls, **NEEDED.get(cls, {}) | values).startswith(says)


@pytest.mark.parametrize("values", [None, 3, "text", ["hop"]])
def test_what_is_no_mapping(values: Any) -> None:
    with pytest.raises(ConfigError, match="here: expected keys and values"):
        build(PaperConfig, values, "here")


@given(
    st.dictionaries(
        st.sampled_from([field.name for field in fields(RobotConfig)]),
        st.none() | st.text() | st.floats() | st.integers() | st.lists(st.integers()),
        max_size=4,
    )
)
def test_no_value_raises_anything_but_a_config_error(values: dict[str, Any]) -> None:
    try:
        build(RobotConfig, values)
    except ConfigError as error:
        assert str(error)


def test_configurations_are_values() -> None:
    config = RobotConfig(robot=1, queue_depth=3)
    with pytest.raises(AttributeError):
        config.queue_depth = 4  # type: ignore[misc]
    assert config == RobotConfig(robot=1, queue_depth=3)


def test_read_yaml(tmp_path: Path) -> None:
    path = tmp_path / "link.yaml"
    path.write_text("hop: 3\nnested: {a: 1}\n")
    assert read_yaml(path) == {"hop": 3, "nested": {"a": 1}}
    path.write_text("")
    assert read_yaml(path) == {}


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (b"a: [1", "no YAML"),
        (b"- 1\n- 2", "expected keys and values, found list"),
        (b"just text", "expected keys and values, found str"),
        (b"\xff\xfe", "cannot be read"),
        (b"a: !!python/object/apply:os.system [true]", "no YAML"),
        (b"a: \x00", "no YAML"),
    ],
)
def test_a_file_that_is_no_configuration(tmp_path: Path, data: bytes, says: str) -> None:
    path = tmp_path / "link.yaml"
    path.write_bytes(data)
    with pytest.raises(ConfigError, match=says) as caught:
        read_yaml(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_key_that_stands_twice_is_named_with_its_lines(tmp_path: Path) -> None:
    path = tmp_path / "link.yaml"
    path.write_text("hop: 1\nros_source:\n  robot_id: 1\nros_source:\n  robot_id: 9\n")
    with pytest.raises(ConfigError) as caught:
        read_yaml(path)
    assert str(caught.value) == f"{path}: key 'ros_source' stands twice, in line 2 and line 4; keep one"


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot be read"):
        read_yaml(tmp_path / "nowhere.yaml")


SCENARIO = {"name": "one", "registry": "table4.csv", "robots": 2}


@pytest.mark.parametrize("share", [0, -1, 0.0])
def test_a_share_of_nothing_is_not_answered_with_no_limit(share: float) -> None:
    with pytest.raises(ConfigError, match=r"duty_cycle = .*: nothing could be sent; set transmit: false"):
        airtime_from({"duty_cycle": share})


@pytest.mark.parametrize(
    ("make", "values", "key"),
    [
        (partial(build, GraphConfig), {"namespace": None}, "namespace = None"),
        (partial(build, GraphConfig), {"domain_id": -1}, "domain_id = -1"),
        (partial(build, SendOptions), {"queue": None}, "queue = None"),
        (partial(build, PublishOptions), {"as": ""}, "as = ''"),
        (scenario_from, {**SCENARIO, "phy": {"sample_rate": 0}}, "phy.sample_rate = 0"),
        (
            link_from,
            {"robot": 1, "phy": {"name": "direct"}, "graph": {"localhost_only": None}},
            "localhost_only = None",
        ),
    ],
)
def test_what_looks_like_auto_is_answered_with_auto(make: Callable[[Any], Any], values: Any, key: str) -> None:
    with pytest.raises(ConfigError, match=rf"{re.escape(key)}: write auto.*\Z"):
        make(values)


def test_a_robot_from_a_list_has_the_settings_of_its_parts() -> None:
    robot = robot_from(robot=1, graph_domain_id=7, publish_as="/far", backfill_topics=["odom"], backfill_for_s=9)
    assert (robot.graph.domain_id, robot.publish.as_) == (7, "/far")
    assert (list(robot.backfill.topics), robot.backfill.for_s) == (["odom"], 9)
