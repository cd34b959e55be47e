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
from gr_ros2.radio.config import link_from
from gr_ros2.settings.config import (
    BurstLoss,
    ChannelConfig,
    PhyConfig,
    SinkConfig,
    SourceConfig,
    TopicOptions,
    airtime_from,
    build,
    read_yaml,
)
from gr_ros2_lab.run.scenario import scenario_from

CONFIGS = (TopicOptions, SourceConfig, SinkConfig, ChannelConfig, PhyConfig)


def refused(cls: type[Any], where: str = "", **values: Any) -> str:
    with pytest.raises(ConfigError) as caught:
        build(cls, values, where)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("cls", CONFIGS)
def test_defaults_are_valid(cls: type[Any]) -> None:
    assert build(cls, {}) == cls()


def test_the_defaults_are_the_designs() -> None:
    source, sink = SourceConfig(), SinkConfig()
    assert (source.packet_len, source.min_fragment, source.greedy, source.flush_timeout_s) == (220, 16, False, 0.0)
    assert (source.robot_id, source.dst_id, source.subscriber_depth, source.hop) == ("auto", 255, 10, 1)
    assert (source.packet_rate, source.middleware, source.entry_ids, source.repeat_s) == (
        "auto",
        "dds",
        "sequential",
        10.0,
    )
    assert (sink.namespace_format, sink.publisher_depth, sink.reassembly_timeout_s) == ("/rx_robot_{robot}", 10, 1.0)
    assert (sink.robot_id, sink.max_sources, sink.packet_len) == ("auto", 16, 220)


@pytest.mark.parametrize("cls", CONFIGS)
def test_an_unknown_key_names_the_known_ones(cls: type[Any]) -> None:
    error = refused(cls, "robots.yaml", colour="red")
    assert error.startswith("robots.yaml: unknown key colour; known are ")
    assert all(field.name in error for field in fields(cls))


def test_an_unknown_key_further_down_is_named_with_its_path() -> None:
    error = refused(SourceConfig, robot_id=1, topic_options={"odom": {"priority": 3}})
    assert "unknown key topic_options.odom.priority" in error


@pytest.mark.parametrize(
    ("cls", "key", "value"),
    [
        (SourceConfig, "packet_len", 13),
        (SourceConfig, "packet_len", 4096),
        (SourceConfig, "robot_id", -2),
        (SourceConfig, "robot_id", 255),
        (SourceConfig, "dst_id", 256),
        (SourceConfig, "hop", 16),
        (SourceConfig, "hop", -1),
        (SourceConfig, "min_fragment", 0),
        (SourceConfig, "flush_timeout_s", -0.1),
        (SourceConfig, "flush_timeout_s", float("nan")),
        (SourceConfig, "packet_rate", float("inf")),
        (SourceConfig, "queue_depth", -1),
        (SourceConfig, "subscriber_depth", -1),
        (SourceConfig, "entry_ids", "backwards"),
        (SourceConfig, "domain_id", 233),
        (SourceConfig, "greedy", "perhaps"),
        (SinkConfig, "reassembly_timeout_s", 0),
        (SinkConfig, "max_sources", 0),
        (SinkConfig, "max_source_bytes", 100),
        (SinkConfig, "publisher_depth", 1.5),
        (ChannelConfig, "packet_loss", 1.01),
        (ChannelConfig, "snr_db", float("nan")),
        (ChannelConfig, "frequency_offset", 0.6),
        (ChannelConfig, "epsilon", 1.1),
        (PhyConfig, "headroom", 0),
        (PhyConfig, "sample_rate", -1),
        (TopicOptions, "qos", "urgent"),
        (TopicOptions, "durability", "eternal"),
        (TopicOptions, "depth", -1),
        (TopicOptions, "queue_depth", 1 << 64),
        (SinkConfig, "publisher_depth", 10**30),
    ],
)
def test_out_of_range_names_key_and_value(cls: type[Any], key: str, value: Any) -> None:
    error = refused(cls, **{key: value})
    assert error.startswith(f"{key} = {value!r}: ")
    assert len(error) > len(f"{key} = {value!r}: ") + 5


@pytest.mark.parametrize(
    ("key", "low", "high"),
    [("packet_len", 14, 4095), ("robot_id", 0, 254), ("dst_id", 0, 255), ("hop", 0, 15), ("domain_id", 0, 232)],
)
def test_the_ends_of_a_range_are_in_it(key: str, low: int, high: int) -> None:
    for value in (low, high):
        assert getattr(build(SourceConfig, {"version": 0, "min_fragment": 1, key: value}), key) == value


@given(packet_len=st.integers(14, 4095), min_fragment=st.integers(1, 4200))
def test_min_fragment_must_fit_a_packet_of_one_entry(packet_len: int, min_fragment: int) -> None:
    values: dict[str, Any] = {"version": 0, "packet_len": packet_len, "min_fragment": min_fragment}
    if min_fragment <= packet_len - 13:
        assert build(SourceConfig, values).min_fragment == min_fragment
    else:
        error = refused(SourceConfig, **values)
        assert (
            f"min_fragment = {min_fragment} does not fit packet_len = {packet_len}; at most {packet_len - 13}" in error
        )


@pytest.mark.parametrize("text", ["/rx_{src}", "/rx_{}", "/rx_{robot", "/rx_}", "/rx_{0}"])
def test_only_the_robot_may_stand_in_braces(text: str) -> None:
    assert f"namespace_format = {text!r}: only {{robot}} may stand in braces" in refused(
        SinkConfig, namespace_format=text
    )


@pytest.mark.parametrize(
    ("namespace", "src_id"),
    [("/robot_34/base", 34), ("/robot_1", 1), ("fleet7/robot_12", 12), ("/robot_007", 7), ("/r254", 254), ("/r0", 0)],
)
def test_the_source_id_is_the_last_run_of_digits(namespace: str, src_id: int) -> None:
    assert SourceConfig(namespace=namespace).src_id() == src_id


@pytest.mark.parametrize(("namespace", "says"), [("", "has no digits"), ("/robot", "has no digits"), ("/r255", "255")])
def test_a_namespace_that_gives_no_source_id(namespace: str, says: str) -> None:
    with pytest.raises(ConfigError, match=says) as caught:
        SourceConfig(namespace=namespace).src_id()
    assert "set robot_id to 0..254" in str(caught.value)


def test_a_configured_robot_id_wins_over_the_namespace() -> None:
    assert SourceConfig(namespace="/robot_1", robot_id=9).src_id() == 9


@pytest.mark.parametrize("text", ["off", "'off'"])
def test_repair_is_switched_off_with_and_without_quotes(tmp_path: Path, text: str) -> None:
    path = tmp_path / "source.yaml"
    path.write_text(f"{{namespace: /robot_1, repair: {text}}}")
    assert build(SourceConfig, read_yaml(path)).repair == "off"


def test_several_errors_are_all_named() -> None:
    error = refused(SourceConfig, hop=99, dst_id=999, colour="red")
    assert all(part in error for part in ("hop = 99", "dst_id = 999", "unknown key colour"))


@pytest.mark.parametrize(
    ("cls", "values", "says"),
    [
        (SourceConfig, {"topics": 5}, "topics = 5: must be a list (which topics are sent: "),
        (SourceConfig, {"greedy": "perhaps"}, "greedy = 'perhaps': must be true or false (several entries"),
        (SourceConfig, {"hop": 1.5}, "hop = 1.5: must be a whole number (initial hop"),
        (SourceConfig, {"hop": 16}, "hop = 16: must be less than or equal to 15"),
        (SourceConfig, {"packet_rate": "fast"}, "packet_rate = 'fast': must be a number (packets/s"),
        (SourceConfig, {"namespace": 3}, "namespace = 3: must be a text"),
        (ChannelConfig, {"taps": []}, "taps = []: must have at least 1 item"),
        (ChannelConfig, {"burst_loss": 1}, "burst_loss = 1: must be keys and values (losses in bursts)"),
        (BurstLoss, {"p_good_to_bad": 0.1}, "p_bad_to_good is missing (the other way round, above 0..1)"),
    ],
)
def test_what_a_setting_must_be_is_said_in_plain_words(cls: type[Any], values: dict[str, Any], says: str) -> None:
    assert refused(cls, **values).startswith(says)


@pytest.mark.parametrize("values", [None, 3, "text", ["hop"]])
def test_what_is_no_mapping(values: Any) -> None:
    with pytest.raises(ConfigError, match="here: expected keys and values"):
        build(SourceConfig, values, "here")


@given(
    st.dictionaries(
        st.sampled_from([field.name for field in fields(SourceConfig)]),
        st.none() | st.text() | st.floats() | st.integers() | st.lists(st.integers()),
        max_size=4,
    )
)
def test_no_value_raises_anything_but_a_config_error(values: dict[str, Any]) -> None:
    try:
        build(SourceConfig, values)
    except ConfigError as error:
        assert str(error)


def test_configurations_are_values() -> None:
    config = SourceConfig(queue_depth=3)
    with pytest.raises(AttributeError):
        config.queue_depth = 4  # type: ignore[misc]
    assert config == SourceConfig(queue_depth=3)


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
        (partial(build, SourceConfig), {"robot_id": -1}, "robot_id = -1"),
        (partial(build, SinkConfig), {"domain_id": -1}, "domain_id = -1"),
        (partial(build, TopicOptions), {"queue": None}, "queue = None"),
        (partial(build, TopicOptions), {"publish_as": ""}, "publish_as = ''"),
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
