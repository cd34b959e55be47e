"""A link in one line is the link of a file: the same settings, and an option nobody has a use for is named."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")

from gr_ros2.core.errors import ConfigError
from gr_ros2.phy import PHY
from gr_ros2.radio import FRONT_ENDS, PRESETS
from gr_ros2.radio.config import link_from, load_link
from gr_ros2.radio.one_line import FLAGS, one_line
from gr_ros2.settings.fields import AUTO
from gr_ros2.settings.files import portable_registry, settled
from gr_ros2.settings.yaml_text import yaml_text

GIVEN: dict[str, dict[str, Any]] = {
    "sim": {},
    "zmq": {"listen": "5551", "peer": ("10.0.0.2:5551", "10.0.0.3:5551")},
    "file": {},
    "soapy": {"frequency": 433.2e6, "device": "driver=hackrf"},
    "uhd": {"frequency": 433.2e6, "frequency-rx": 434.4e6},
    "pluto": {"frequency": 433.2e6},
    "audio": {"device": "USB"},
    "kiss": {"device": "tcp://localhost:8001"},
    "serial": {"device": "/dev/ttyUSB0"},
    "udp": {"listen": "5551", "peer": ("10.0.0.2:5551",)},
}


@pytest.mark.parametrize("radio", list(FRONT_ENDS.own))
def test_the_yaml_it_prints_says_the_same(radio: str, tmp_path: Path) -> None:
    values = settled(
        one_line(7, radio, None, GIVEN[radio]), Path(), ["front_end.write=sent"] if radio == "file" else []
    )
    settings = link_from(values)
    assert (settings.name, settings.robot_id, settings.namespace) == ("robot_7", 7, "/robot_7")
    row = FRONT_ENDS[radio]
    assert (settings.phy.name, settings.phy.options) == (row.phy, row.phy_options)
    assert settings.phy.sample_rate == (row.sample_rate if PHY.load(row.phy).has_samples else AUTO)
    FRONT_ENDS.load(radio).Options(**settings.front_end_options)
    path = tmp_path / "saved.yaml"
    path.write_text(yaml_text(values))
    assert load_link(path) == settings


@pytest.mark.parametrize("radio", list(PRESETS))
def test_a_preset_prints_what_it_stands_for(radio: str) -> None:
    row = PRESETS[radio]
    settings = link_from(settled(one_line(7, radio, None, {"device": "/dev/ttyUSB0"}), Path(), []))
    assert (settings.packet_len, settings.phy.options) == (row.packet_len, row.phy_options)
    assert settings.front_end == {"name": row.front_end, **row.settings, "device": "/dev/ttyUSB0"}


def test_a_registry_of_ones_own_is_found_from_anywhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "mine.csv").write_text("odom,nav_msgs/Odometry\n")
    monkeypatch.chdir(tmp_path)
    values = settled(one_line(1, "sim", "mine.csv", {}), Path())
    assert portable_registry(values["registry"]) == str(tmp_path / "mine.csv")
    assert portable_registry(settled(one_line(1, "sim", "table4", {}), Path())["registry"]) == "table4"


def test_a_number_and_a_radio_are_enough() -> None:
    settings = link_from(settled(one_line(1, "sim", None, {}), Path()))
    assert (settings.registry, list(settings.topics), settings.compression) == ("", ["auto"], True)


def test_topics_of_the_graph_need_no_registry(tmp_path: Path) -> None:
    values = settled(one_line(1, "sim", None, {}, "auto, -camera/*"), Path())
    settings = link_from(values)
    assert (settings.registry, list(settings.topics)) == ("", ["auto", "-camera/*"])
    path = tmp_path / "saved.yaml"
    path.write_text(yaml_text(values))
    assert load_link(path) == settings
    assert load_link(path, ["topics=auto, -camera/*"]) == settings
    assert portable_registry(settled(one_line(1, "sim", "table4", {}, "odom"), Path())["registry"]) == "table4"


@pytest.mark.parametrize(
    ("radio", "flags", "said"),
    [
        ("zmq", {"listen": "5551"}, r"--peer is missing, radio zmq needs it \(zmq, udp: address of another robot"),
        ("pluto", {}, r"--frequency is missing, radio pluto needs it \(Hz"),
        ("pluto", {"peer": ("a:1",)}, "--peer: radio pluto has no such setting; it takes --device, --frequency"),
        ("sim", {"listen": "5551"}, "--listen: radio sim has no such setting; it takes none"),
        ("zeromq", {}, "no 'zeromq'; known are sim, zmq"),
    ],
)
def test_an_option_too_many_or_too_few_is_named(radio: str, flags: dict[str, Any], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        one_line(1, radio, None, flags)


def test_every_option_is_a_setting_of_some_radio() -> None:
    settings = {name for radio in FRONT_ENDS.own for name in FRONT_ENDS.load(radio).Options.__dataclass_fields__}
    assert {setting for flag in FLAGS.values() for setting in flag.settings} <= settings
