"""What has no effect where it is given is refused in one line: each condition, and each option of one end alone."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import pytest

from gr_ros2.core.errors import ConfigError
from gr_ros2.radio.config import LinkConfig, link_from
from gr_ros2.settings.airtime import AirtimeConfig
from gr_ros2.settings.config import (
    CameraOptions,
    CloudOptions,
    DepthOptions,
    PhyConfig,
    ScenarioChannel,
    SendOptions,
    build,
)
from gr_ros2.settings.effect import conditions_of
from gr_ros2.settings.robot import RobotConfig
from gr_ros2_lab.medium.process import MediumConfig
from gr_ros2_lab.run.robot_settings import ScenarioRobot
from gr_ros2_lab.run.scenario import Scenario, scenario_from
from tests.settings.test_fields import classes

ROBOTS = [{"connect": f"tcp://127.0.0.1:555{n}", "bind": f"tcp://127.0.0.1:655{n}"} for n in (1, 2)]
BASE: Mapping[type[Any], Mapping[str, Any]] = {
    Scenario: {"name": "one", "registry": "table4.csv", "robots": [{}, {}]},
    ScenarioRobot: {"robot": 1},
    RobotConfig: {"robot": 1},
    LinkConfig: {"phy": {"sample_rate": 1e6}, "robot": 1},
    MediumConfig: {"phy": {"sample_rate": 1e6}, "robots": ROBOTS},
}
TWO = {"time": "packets"}
TWO_RADIOS = [{"name": name, "front_end": {"name": "sim"}} for name in ("one", "two")]
PLACED = {"channel": {"from": "positions"}}
COMPRESSES = "set compression: true, or leave it out"
CAMERA: dict[str, Any] = {"size": "full", "fps": 5.0, "output": "FFMPEGPacket"}
DEPTH: dict[str, Any] = {"mode": "exact", "near": 0.5, "far": 9.0}
BY_TYPE: dict[str, Any] = {
    "cloud.voxel": {"cloud": {"voxel": 0.1}},
    **{f"camera.{name}": {"camera": {name: value}} for name, value in CAMERA.items()},
    **{f"depth_image.{name}": {"depth_image": {name: value}} for name, value in DEPTH.items()},
}

Values = Mapping[str, Any]
IDLE: dict[tuple[type[Any], str], tuple[Values, Values, Values, str]] = {
    (SendOptions, "queue_depth"): ({"queue_depth": 3}, {"queue": "latest"}, {"queue": "fifo"}, "set another queue"),
    (PhyConfig, "headroom"): (
        {"headroom": 2.0},
        {"sample_rate": 1e6},
        {"sample_rate": "auto"},
        "set sample_rate: auto",
    ),
    (AirtimeConfig, "window_s"): ({"window_s": 60.0}, {}, {"band": "eu868"}, "set duty_cycle"),
    (ScenarioChannel, "snr_db"): ({"snr_db": 3.0}, {"from": "positions"}, {}, "set from: settings"),
    (ScenarioChannel, "model"): ({"model": "two_ray"}, {}, {"from": "positions"}, "set from: positions"),
    (ScenarioChannel, "exponent"): (
        {"exponent": 2.0},
        {"from": "positions", "model": "two_ray"},
        {"from": "positions"},
        "set model: log_distance",
    ),
    (ScenarioChannel, "height_m"): (
        {"height_m": 2.0},
        {"from": "positions"},
        {"from": "positions", "model": "two_ray"},
        "set model: two_ray",
    ),
    (ScenarioChannel, "walls_db"): ({"walls_db": 2.0}, {}, {"from": "positions"}, "set from: positions"),
    (ScenarioChannel, "shadowing_db"): ({"shadowing_db": 2.0}, {}, {"from": "positions"}, "set from: positions"),
    (ScenarioChannel, "decorrelation_m"): (
        {"decorrelation_m": 2.0},
        {"from": "positions"},
        {"from": "positions", "shadowing_db": 4.0},
        "set shadowing_db above 0",
    ),
    (ScenarioChannel, "carrier_hz"): ({"carrier_hz": 868e6}, {}, {"from": "positions"}, "set from: positions"),
    (Scenario, "bag_speed"): (
        {"bag_speed": 2.0},
        {"robots": [{}, {"topics": []}]},
        {"robots": [{}, {"topics": []}], "source": "bag:a"},
        "set source: bag:PATH",
    ),
    (Scenario, "robots.*.state"): ({"robots": [{}, {"state": "robot.json"}]}, {}, {}, "leave it out"),
    (Scenario, "robots.*.topics.*.via"): (
        {"robots": [{}, {"topics": {"odom": {"via": "all"}}}]},
        {},
        {},
        "leave it out",
    ),
    (Scenario, "robots.*.backfill.topics"): (
        {"robots": [{}, {"backfill": {"topics": ["odom"]}}]},
        {},
        {},
        "leave it out",
    ),
    (Scenario, "robots.*.publish.stamps"): ({"robots": [{}, {"publish": {"stamps": "mine"}}]}, {}, {}, "leave it out"),
    (LinkConfig, "publish.stamps"): (
        {"publish": {"stamps": "mine"}},
        {"graph": {"use_sim_time": True}},
        {},
        "leave graph.use_sim_time or publish.stamps out",
    ),
    **{
        (LinkConfig, f"{part}.*.via"): (
            {part: {"odom": {"via": "all"}}},
            {},
            {"radios": TWO_RADIOS},
            "set radios",
        )
        for part in ("topics", "offer")
    },
    (Scenario, "robots.*.offer"): ({"robots": [{}, {"offer": ["scan"]}]}, {}, {}, "leave it out"),
    (LinkConfig, "front_end"): ({"front_end": {"name": "udp"}}, {"radios": TWO_RADIOS}, {"radios": ()}, "leave it out"),
    (LinkConfig, "medium"): (
        {"medium": "slots"},
        {"radios": [{**radio, "medium": "exclusive"} for radio in TWO_RADIOS]},
        {"radios": ()},
        "each radio has its own",
    ),
    (LinkConfig, "record"): ({"record": "heard"}, {"radios": TWO_RADIOS}, {"radios": ()}, "leave it out"),
    (Scenario, "controller"): (
        {"controller": "ros"},
        {},
        {"task": "formation"},
        "set task and time: real",
    ),
}
for cls in (ScenarioRobot, LinkConfig):
    for name, given in (
        ("seal", {"seal": "authenticate"}),
        ("max_age_s", {"max_age_s": 5.0}),
        ("publish.topics.*.max_age_s", {"publish": {"topics": {"odom": {"max_age_s": 5.0}}}}),
    ):
        IDLE[cls, name] = (given, {}, {"key": "fleet.key"}, "set key")
    for option, given in {
        "codec": {"codec": "zstd"},
        "quantize": {"quantize": "pose=0.1"},
        **BY_TYPE,
    }.items():
        for part in ("topics", "offer"):
            IDLE[cls, f"{part}.*.{option}"] = ({part: {"odom": given}}, {"compression": False}, {}, COMPRESSES)
    IDLE[cls, "offer"] = ({"offer": ["scan"]}, {"direction": "send"}, {}, "set direction: both")
    for option, value in {"robots": [2], "for_s": 60.0, "memory_mb": 60.0}.items():
        of = {"backfill": {option: value}}
        IDLE[cls, f"backfill.{option}"] = (of, {}, {"backfill": {"topics": ["odom"]}}, "set backfill.topics")
    IDLE[cls, "expected_loss"] = ({"expected_loss": 0.5}, {"repair": "off"}, {"repair": "idle"}, "set repair to")
    IDLE[cls, "beacon_s"] = ({"beacon_s": 9.0}, {"direction": "send"}, {}, "set direction: both")
for cls, beside in ((Scenario, TWO), (MediumConfig, {})):
    for name, given in (
        ("channel.tx_power_dbm", {"channel": {"tx_power_dbm": 3.0}}),
        ("channel.noise_figure_db", {"channel": {"noise_figure_db": 3.0}}),
        ("robots.*.tx_power_dbm", {"robots": [{}, {"tx_power_dbm": 3.0}]}),
        ("robots.*.noise_figure_db", {"robots": [{}, {"noise_figure_db": 3.0}]}),
    ):
        IDLE[cls, name] = (given, beside, {**beside, "gains_db": -90.0}, "set gains_db, or channel.from: positions")
    IDLE[cls, "channel.snr_db"] = ({"channel": {"snr_db": 9.0}}, {**beside, "gains_db": -90.0}, beside, "leave one")
for option, given in BY_TYPE.items():
    IDLE[SendOptions, option] = (given, {"codec": "zstd"}, {}, "leave codec out")
for cls, values in ((CameraOptions, CAMERA), (DepthOptions, DEPTH)):
    for name, value in values.items():
        IDLE[cls, name] = ({name: value}, {"off": True}, {}, "leave off out")
for name, value in {"range": 30.0, "keep": "rgb", "fit": True}.items():
    IDLE[CloudOptions, name] = ({name: value}, {}, {"voxel": 0.1}, "set voxel above 0")
NEVER = {
    (Scenario, f"robots.*.{name}") for name in ("state", "offer", "publish.stamps", "topics.*.via", "backfill.topics")
}
"""Nothing makes them act."""


def made(cls: type[Any], *parts: Values) -> Any:
    """An object of a settings class from values, of which later ones are merged into earlier ones."""
    values: dict[str, Any] = {}
    for part in (BASE.get(cls, {}), *parts):
        values = merged(values, part)
    makers = {Scenario: scenario_from, LinkConfig: link_from}
    return makers[cls](values) if cls in makers else build(cls, values)


def merged(below: Any, above: Any) -> Any:
    if isinstance(below, Mapping) and isinstance(above, Mapping):
        return {key: merged(below.get(key), above.get(key, below.get(key))) for key in {**below, **above}}
    if isinstance(below, list) and isinstance(above, list):
        return [merged(one, other) for one, other in zip(below, above, strict=True)]
    return above


def test_every_condition_is_here() -> None:
    held = {(cls, name) for cls in classes() for condition in conditions_of(cls) for name in condition.settings}
    assert set(IDLE) == held


@pytest.mark.parametrize(("cls", "name"), IDLE, ids=lambda one: one if isinstance(one, str) else one.__name__)
def test_what_has_no_effect_is_refused_in_a_line(cls: type[Any], name: str) -> None:
    given, idle, acting, remedy = IDLE[cls, name]
    with pytest.raises(ConfigError) as error:
        made(cls, idle, given)
    pattern = re.escape(name).replace(r"\.\*", r"(\.\w+|\[\d\])")
    assert re.search(rf"(^|: ){pattern} = \S+: .*{re.escape(remedy)}", str(error.value))
    assert "\n" not in str(error.value)
    made(cls, idle)
    if (cls, name) not in NEVER:
        made(cls, acting, given)


def test_a_default_is_taken_wherever_it_stands() -> None:
    given = {"robot": 1, "repair": "off", "expected_loss": 0.2}
    assert build(RobotConfig, given) == RobotConfig(robot=1, repair="off")
    assert build(PhyConfig, {"sample_rate": 1e6, "headroom": 1.2}) == PhyConfig(sample_rate=1e6)
    assert made(Scenario, {"bag_speed": 1, "robots": [{"tx_power_dbm": "auto"}, {}]}) == made(Scenario)
