"""Settings as ROS parameters: the same names, meanings and ranges as everywhere."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from gr_ros2.radio.config import LinkConfig, link_from
from gr_ros2.ros.parameters import Parameter, overrides, parameters
from gr_ros2.settings.config import ChannelConfig, SinkConfig, SourceConfig, build
from gr_ros2.settings.fields import meanings
from gr_ros2.settings.files import parse_override, settled

LINK = {
    "registry": "topics.csv",
    "ros_source": {"robot_id": 1, "topic_options": {"scan": {"queue": "latest"}}},
    "phy": {"name": "direct"},
    "front_end": {"name": "sim"},
    "channel": {"snr_db": 20, "taps": ["1", "0.5j"]},
}


@dataclass
class Inner:
    """:param depth: how deep"""

    depth: int = 3


@dataclass
class Outer:
    """Something.

    :param inner: what is within
    :param maybe: or not
    """

    inner: Inner = field(default_factory=Inner)
    maybe: int | None = None


def flat(settings: Any) -> dict[str, Parameter]:
    return {parameter.name: parameter for parameter in parameters(settings)}


def test_every_setting_is_a_parameter_with_its_meaning() -> None:
    found = flat(link_from(LINK))
    for prefix, cls in (("", LinkConfig), ("ros_source.", SourceConfig), ("ros_sink.", SinkConfig)):
        for name in meanings(cls):
            assert any(other == prefix + name or other.startswith(f"{prefix}{name}.") for other in found) or (
                getattr(build(cls, LINK) if cls is LinkConfig else cls(), name) == {}
            ), name
    assert all(parameter.meaning for parameter in found.values())
    assert found["ros_source.topic_options.scan.queue"].value == "latest"
    assert found["front_end.name"].value == "sim"


def test_ranges_and_choices_are_those_of_the_configuration() -> None:
    found = flat(link_from(LINK))
    assert (found["packet_len"].minimum, found["packet_len"].maximum) == (14, 4095)
    assert (found["ros_sink.reassembly_timeout_s"].minimum, found["ros_sink.reassembly_timeout_s"].rule) == (
        0,
        "above 0",
    )
    assert found["ros_source.entry_ids"].rule == "one of sequential, random"
    assert (found["channel.snr_db"].minimum, found["channel.snr_db"].maximum) == (-50, 100)
    assert found["ros_source.hop"].strict and not found["channel.snr_db"].strict
    assert found["ros_source.topics"].value == []
    assert found["channel.taps"].value == ["(1+0j)", "0.5j"]


def test_what_ros_shows_is_what_ros_may_give() -> None:
    """Every parameter, given back as an override, makes the same link."""
    link = link_from(LINK)
    shown = {name: item.value for name, item in flat(link).items() if item.value is not None}
    values: dict[str, Any] = {}
    for text in overrides(shown):
        keys, value = parse_override(text)
        inner = values
        for key in keys[:-1]:
            inner = inner.setdefault(key, {})
        inner[keys[-1]] = value
    for end in ("ros_source", "ros_sink"):
        assert (values[end].pop("registry"), values[end].pop("packet_len")) == ("topics.csv", 220)
    assert link_from(values) == link


@pytest.mark.parametrize(
    "text", ["a: b", "on", "1e3", "{x}", "", "robot_{src_id}/", 'quoted "word"', "# no comment", "bag:/tmp/x"]
)
def test_texts_survive(text: str) -> None:
    (override,) = overrides({"ros_sink.frame_prefix": text})
    assert parse_override(override) == (("ros_sink", "frame_prefix"), text)


def test_what_version_1_takes_is_the_same_as_parameters_in_yaml_and_in_python() -> None:
    """As ``-p key:=fleet.key -p ros_source.topics:="auto, -camera/*" …`` gives them; a list of texts is one too."""
    given = {
        "key": "fleet.key",
        "seal": "authenticate",
        "registry": "",
        "ros_source.repair": "idle",
        "ros_source.expected_loss": 0.05,
    }
    file = {
        **{"key": "fleet.key", "seal": "authenticate", "registry": ""},
        "ros_source": {"robot_id": 1, "repair": "idle", "expected_loss": 0.05, "topics": ["auto", "-camera/*"]},
        "phy": {"name": "direct"},
    }
    for topics in ("auto, -camera/*", ["auto", "-camera/*"]):
        start = {"phy": {"name": "direct"}, "ros_source": {"robot_id": 1}}
        values = settled(start, Path(), overrides({**given, "ros_source.topics": topics}))
        assert link_from(values) == link_from(file)
    shown = flat(link_from(file))
    assert shown["ros_source.topics"].value == ["auto", "-camera/*"]
    assert not shown["ros_source.topics"].strict, "a text may stand where a list is shown"
    assert (shown["key"].value, shown["ros_source.repair"].rule) == ("fleet.key", "one of idle, thrifty, off, auto")


def test_nested_and_optional_settings() -> None:
    names = [(parameter.name, parameter.value) for parameter in parameters(Outer(), "x.")]
    assert names == [("x.inner.depth", 3), ("x.maybe", None)]
    assert flat(ChannelConfig())["snr_db"].value is None
