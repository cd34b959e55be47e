"""Scenarios: the built-in ones, overrides, and errors that name what is wrong."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from gr_ros2.core.errors import ConfigError
from gr_ros2.settings.config import Agreed, ChannelConfig, replaced
from gr_ros2.settings.files import parse_override
from gr_ros2_lab.medium.base import Path as Way
from gr_ros2_lab.run.builtin import builtin_scenarios
from gr_ros2_lab.run.scenario import changed, dump, load_scenario, scenario_from

BUILTIN = {scenario.name: scenario for scenario in map(load_scenario, builtin_scenarios())}


def test_the_built_in_ones() -> None:
    assert {"demo", "paper-direct", "paper-ofdm", "paper-ofdm-paced", "six-topics-paced", "two-way"} <= set(BUILTIN)
    channels = ("awgn", "multipath", "cfo", "clock-offset", "rayleigh", "burst-loss", "unplugged")
    assert {f"channel-{name}" for name in channels} <= set(BUILTIN)
    assert all(BUILTIN[f"channel-{name}"].channel != ChannelConfig(seed=0) for name in channels)
    demo, direct, ofdm = BUILTIN["demo"], BUILTIN["paper-direct"], BUILTIN["paper-ofdm"]
    assert (demo.packet_len, demo.phy.name, demo.phy.sample_rate, demo.phy.headroom) == (220, "ofdm", "auto", 1.2)
    assert (direct.packet_len, direct.sim.odom_rate, direct.duration_s, direct.phy.name) == (64, 30, 15, "direct")
    assert (ofdm.packet_len, ofdm.sim.odom_rate, ofdm.duration_s, ofdm.phy.sample_rate) == (64, 35, 38, 100_000)
    assert (ofdm.ros_source.packet_rate, ofdm.drain_s, ofdm.ros_source.queue_depth) == (0, 0, 0)
    assert BUILTIN["paper-ofdm-paced"].ros_source.packet_rate == "auto"
    assert BUILTIN["paper-ofdm-paced"].ros_source.queue_depth > 0


@pytest.mark.parametrize("name", sorted(BUILTIN))
def test_each_is_ready_to_run(name: str) -> None:
    scenario = BUILTIN[name]
    assert scenario.description
    assert scenario.duration_s + scenario.drain_s <= (65 if scenario.time != "real" else 40), (
        "in real time it is waited for"
    )
    assert scenario.all_robots[0].robot_id == 1
    assert scenario.ros_source.packet_len == scenario.ros_sink.packet_len == scenario.packet_len
    assert scenario.ros_source.registry == scenario.ros_sink.registry == scenario.registry
    assert {scenario.ros_source.domain_id, scenario.ros_sink.domain_id} == {"auto"}, "free ones, or that of the shell"
    assert scenario.own_domains == (name != "one-graph")
    assert "odom" in [topic.name for topic in scenario.load_registry()]


@pytest.mark.parametrize("name", sorted(BUILTIN))
def test_a_dump_makes_the_same_scenario(name: str) -> None:
    assert scenario_from(json.loads(json.dumps(dump(BUILTIN[name])))) == BUILTIN[name]


def test_overrides() -> None:
    changes = ["packet_len=64", "phy.sample_rate=2e5", "ros_source.topics=[odom, /imu]", "ros_source.namespace="]
    changes += ["channel.taps=[1, 0, 0, 0.4]", "source=bag:~/a b", "ros_source.robot_id=7", "phy.options.fft_len=128"]
    scenario = load_scenario("demo", changes, seed=5, duration_s=None)
    assert scenario.packet_len == scenario.ros_source.packet_len == scenario.ros_sink.packet_len == 64
    assert scenario.phy.sample_rate == 200_000
    assert scenario.phy.options == {"fft_len": 128}
    assert scenario.ros_source.topics == ("odom", "/imu")
    assert scenario.ros_source.namespace == ""
    assert scenario.channel.taps == (1, 0, 0, 0.4)
    assert scenario.bag_path == Path("~/a b").expanduser()
    assert (scenario.seed, scenario.channel.seed, scenario.sim.seed) == (5, 5, 5)
    assert scenario.duration_s == BUILTIN["demo"].duration_s
    assert BUILTIN["demo"].bag_path is None


def test_a_seed_of_its_own_stays() -> None:
    scenario = load_scenario("demo", ["channel.seed=9"], seed=5)
    assert (scenario.channel.seed, scenario.sim.seed) == (9, 5)


def test_the_way_back_is_the_way_there_with_the_graphs_swapped() -> None:
    changes = ["ros_source.compression=true", "ros_source.robot_id=1", "ros_sink.robot_id=2", "channel.snr_db=20"]
    changes += [
        "reports=null",
        "back.ros_source.namespace=/robot_2",
        "back.ros_sink.publisher_depth=7",
        "phy.sample_rate=2e5",
    ]
    there = load_scenario("demo", changes, seed=5)
    back = there.back
    assert back is not None
    assert replace(there, back=None) == load_scenario("demo", [c for c in changes if not c.startswith("back")], seed=5)
    here, other = there.all_robots
    assert (here.source, other.source) == (there.ros_source, back.ros_source)
    assert (here.sink, other.sink) == (back.ros_sink, there.ros_sink)  # each hears the other's source
    assert (here.paths, other.paths) == ((Way(1, there.channel),), (Way(0, back.channel),))
    assert (back.ros_source.domain_id, back.ros_sink.domain_id) == (
        there.ros_sink.domain_id,
        there.ros_source.domain_id,
    )
    assert (back.ros_source.src_id(), back.ros_sink.robot_id) == (2, "auto")  # a robot's own settings stay its own
    assert back.ros_source.compression
    assert (there.ros_sink.publisher_depth, back.ros_sink.publisher_depth) == (1000, 7)
    assert back.ros_source.registry == there.registry
    assert back.channel.snr_db == 20
    assert back.channel.seed != there.channel.seed == 5


def test_a_part_is_changed_at_all_robots() -> None:
    for name in ("two-way", "team", "demo"):
        scenario = changed(BUILTIN[name], Agreed, lambda part: replaced(part, packet_len=99))
        halves = [half for robot in scenario.all_robots for half in (robot.source, robot.sink) if half is not None]
        assert {scenario.packet_len, *(half.packet_len for half in halves)} == {99}
        assert changed(scenario, Agreed, lambda part: replaced(part, packet_len=64)) == changed(
            BUILTIN[name], Agreed, lambda part: replaced(part, packet_len=64)
        )


def test_override_values_are_yaml() -> None:
    assert parse_override("a.b = 2e5") == (("a", "b"), 200_000.0)
    assert parse_override("a=true") == (("a",), True)
    assert parse_override("a={b: 1}") == (("a",), {"b": 1})
    assert parse_override("a=bag: x=y") == (("a",), "bag: x=y")
    assert parse_override("a=") == (("a",), "")


@pytest.mark.parametrize(
    ("override", "says"),
    [
        ("foo=1", "unknown key foo; known are packet_len, registry"),
        ("phy.foo=1", "unknown key phy.foo; known are name, sample_rate"),
        ("phy.sample_rate=-1", "phy.sample_rate = -1: write auto"),
        ("phy.sample_rate=-2", "phy.sample_rate = -2: must be greater than 0, or 'auto'"),
        ("packet_len=9", "^demo: packet_len = 9: [^;]*$"),
        ("seed=x", "^demo: seed = 'x': [^;]*$"),
        ("sim.robots=0", "sim.robots = 0"),
        ("ros_source.packet_len=64", "ros_source.packet_len = 64: both ends share it; set packet_len"),
        ("ros_source.min_fragment=999", "ros_source: min_fragment = 999: version 1 has no such setting"),
        ("ros_source.middleware=foo", "ros_source.middleware = 'foo': .* known are dds"),
        ("phy.name=foo", "phy.name = 'foo': .* known are direct, ofdm"),
        ("ros_source=5", "ros_source = 5"),
        ("packet_len.x=4", "packet_len has no settings below it"),
        ("source=bag:", "the path of the bag is missing"),
        ("source=dds", "write sim or bag:PATH"),
        ("registry=nope", "registry = 'nope': no such file; built in are odom, rtk, search, table4"),
        ("duration_s=0", "the simulator has no end"),
        ("channel.taps=[", "the value is no YAML"),
        ("packet_len", "write key=value"),
        ("channel.snr_db=101", "channel.snr_db = 101: .* less than or equal to 100"),
        ("channel.doppler_hz=-1", "channel.doppler_hz = -1"),
        ("channel.taps=[]", "channel.taps = .*at least 1"),
        ("channel.outages=[[5, 3]]", r"outages: \[5, 3\] ends before it begins"),
        ("channel.outages=[[1, 3], [2, 4]]", r"outages: \[2, 4\] .* before the one before it has ended"),
        ("channel.burst_loss={p_good_to_bad: 0.1}", "channel.burst_loss.p_bad_to_good is missing"),
        (
            "channel.burst_loss={p_good_to_bad: 0.1, p_bad_to_good: 0}",
            "channel.burst_loss.p_bad_to_good = 0: .* greater than 0",
        ),
        (
            "channel.burst_loss={p_good_to_bad: 0.1, p_bad_to_good: 1, loss: 1}",
            "unknown key channel.burst_loss.loss; known are p_good_to_bad, p_bad_to_good, loss_good, loss_bad",
        ),
        ("repetitions=0", "repetitions = 0: .* greater than or equal to 1"),
        ("back={}", "back.ros_source: .* set robot_id to 0..254"),
        ("back=5", "back = 5"),
        ("back={ros_source: 5}", "back.ros_source = 5"),
        ("back={ros_source: {namespace: /robot_1}}", "back.ros_source: source id 1 is that of ros_source"),
        ("back={ros_source: {colour: 1}}", "unknown key back.ros_source.colour; known are packet_len, registry"),
        ("back={ros_sink: {packet_len: 9}}", "back.ros_sink.packet_len = 9: both ends share it"),
        (".packet_len=1", "write key=value"),
    ],
)
def test_what_is_wrong_is_named(override: str, says: str) -> None:
    with pytest.raises(ConfigError, match=says) as caught:
        load_scenario("demo", [override])
    assert "\n" not in str(caught.value)


def test_a_recording_speaks_for_one_robot() -> None:
    with pytest.raises(ConfigError, match="back: source = 'bag:here' speaks for one robot"):
        load_scenario("two-way", ["source=bag:here"])


def test_a_file_with_a_registry_beside_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "mine.csv").write_text("fix,sensor_msgs/NavSatFix\n")
    path = tmp_path / "field-trial.yaml"
    path.write_text("registry: mine.csv\nsource: bag:here\nduration_s: 0\nros_source: {robot_id: 3}\n")
    scenario = load_scenario(path)
    assert (scenario.name, scenario.duration_s, scenario.bag_path) == ("field-trial", 0, Path("here"))
    assert [topic.name for topic in scenario.load_registry()] == ["fix"]
    monkeypatch.chdir(tmp_path)
    assert load_scenario("demo", ["registry=mine.csv"]).registry == str(tmp_path / "mine.csv")


def test_neither_a_file_nor_built_in() -> None:
    with pytest.raises(
        ConfigError, match=r"'dmeo' is neither a file nor built in; built in are channel-awgn, .*paper-direct"
    ):
        load_scenario("dmeo")
