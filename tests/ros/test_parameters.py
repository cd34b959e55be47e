"""Settings as ROS parameters: the same names, meanings and ranges as everywhere."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import pytest

from gr_ros2.radio.config import LinkConfig, link_from
from gr_ros2.ros.parameters import Parameter, overrides, parameters
from gr_ros2.settings.config import ChannelConfig
from gr_ros2.settings.fields import meanings
from gr_ros2.settings.files import find_registry, parse_override, settled

LINK = {
    "robot": "/robot_1",
    "registry": "topics.csv",
    "topics": {"auto": None, "scan": {"queue": "latest"}},
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
    link = link_from(LINK)
    found = flat(link)
    for name in meanings(LinkConfig):
        assert any(other == name or other.startswith(f"{name}.") for other in found), name
    assert all(parameter.meaning for parameter in found.values())
    assert found["topics.scan.queue"].value == "latest"
    assert "topics.scan.weight" not in found, "options at their defaults are not shown"
    assert found["publish.as"].value == "/rx_robot_{robot}"
    assert found["front_end.name"].value == "sim"


def test_ranges_and_choices_are_those_of_the_configuration() -> None:
    found = flat(link_from(LINK))
    assert (found["packet_len"].minimum, found["packet_len"].maximum) == (14, 4095)
    assert found["seal"].rule == "one of encrypt, authenticate"
    assert (found["channel.snr_db"].minimum, found["channel.snr_db"].maximum) == (-50, 100)
    assert found["queue_depth"].strict and not found["channel.snr_db"].strict
    assert found["topics"].value == ["auto", "scan"]
    assert found["channel.taps"].value == ["(1+0j)", "0.5j"]


def test_what_ros_shows_is_what_ros_may_give() -> None:
    """Every parameter, given back as an override, makes the same link."""
    link = link_from(LINK)
    shown = {name: item.value for name, item in flat(link).items() if item.value is not None}
    assert link_from(
        settled({}, Path(), [text for text in overrides(shown) if not text.startswith("registry=")] + ["registry=odom"])
    ) == replace(link, registry=find_registry("odom", Path()))


@pytest.mark.parametrize(
    "text", ["a: b", "on", "1e3", "{x}", "", "robot_{robot}/", 'quoted "word"', "# no comment", "bag:/tmp/x"]
)
def test_texts_survive(text: str) -> None:
    (override,) = overrides({"publish.frame_prefix": text})
    assert parse_override(override) == (("publish", "frame_prefix"), text)


def test_what_a_robot_sends_is_the_same_as_parameters_in_yaml_and_in_python() -> None:
    """As ``-p key:=fleet.key -p topics:="auto, -camera/*" …`` gives them; a list of texts is one too."""
    given = {"key": "fleet.key", "seal": "authenticate", "registry": "", "repair": "idle", "expected_loss": 0.05}
    file = {**given, "robot": 1, "topics": ["auto", "-camera/*"], "phy": {"name": "direct"}}
    for topics in ("auto, -camera/*", ["auto", "-camera/*"]):
        values = settled({"phy": {"name": "direct"}, "robot": 1}, Path(), overrides({**given, "topics": topics}))
        assert link_from(values) == link_from(file)
    shown = flat(link_from(file))
    assert shown["topics"].value == ["auto", "-camera/*"]
    assert not shown["topics"].strict, "a text may stand where a list is shown"
    assert (shown["key"].value, shown["repair"].rule) == ("fleet.key", "one of idle, thrifty, off, auto")


def test_nested_and_optional_settings() -> None:
    names = [(parameter.name, parameter.value) for parameter in parameters(Outer(), "x.")]
    assert names == [("x.inner.depth", 3), ("x.maybe", None)]
    assert flat(ChannelConfig())["snr_db"].value is None
