"""Scenarios: the built-in ones, overrides, and errors that name what is wrong."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from gr_ros2.core.errors import ConfigError
from gr_ros2.paper.settings import PaperConfig
from gr_ros2.settings.config import ChannelConfig, replaced
from gr_ros2.settings.files import parse_override
from gr_ros2.settings.robot import RobotConfig
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
    assert (ofdm.first.packet_rate, ofdm.drain_s, ofdm.first.queue_depth, ofdm.paper) == (0, 0, 0, PaperConfig())
    assert BUILTIN["paper-ofdm-paced"].first.packet_rate == "auto"
    assert BUILTIN["paper-ofdm-paced"].first.queue_depth > 0


@pytest.mark.parametrize("name", sorted(BUILTIN))
def test_each_is_ready_to_run(name: str) -> None:
    scenario = BUILTIN[name]
    assert scenario.description
    assert scenario.duration_s + scenario.drain_s <= (65 if scenario.time != "real" else 40), (
        "in real time it is waited for"
    )
    assert scenario.all_robots[0].robot_id == 1
    assert {robot.graph.domain_id for robot in scenario.robots} == {"auto"}, "free ones, or that of the shell"
    assert scenario.own_domains == (name != "one-graph")
    assert "odom" in [topic.name for topic in scenario.load_registry()]


@pytest.mark.parametrize("name", sorted(BUILTIN))
def test_a_dump_makes_the_same_scenario(name: str) -> None:
    assert scenario_from(json.loads(json.dumps(dump(BUILTIN[name])))) == BUILTIN[name]


def test_overrides() -> None:
    changes = ["packet_len=64", "phy.sample_rate=2e5", "topics=[odom, /imu]", "robots.0.graph.namespace="]
    changes += ["channel.taps=[1, 0, 0, 0.4]", "source=bag:~/a b", "robots.0.robot=7", "phy.options.fft_len=128"]
    scenario = load_scenario("demo", changes, seed=5, duration_s=None)
    assert scenario.packet_len == scenario.robots[1].packet_len == 64
    assert scenario.phy.sample_rate == 200_000
    assert scenario.phy.options == {"fft_len": 128}
    robot = scenario.robots[0]
    assert (list(robot.topics), robot.namespace, robot.robot_id) == (["odom", "/imu"], "", 7)
    assert scenario.channel.taps == (1, 0, 0, 0.4)
    assert scenario.bag_path == Path("~/a b").expanduser()
    assert (scenario.seed, scenario.channel.seed, scenario.sim.seed) == (5, 5, 5)
    assert scenario.duration_s == BUILTIN["demo"].duration_s
    assert BUILTIN["demo"].bag_path is None


def test_a_seed_of_its_own_stays() -> None:
    scenario = load_scenario("demo", ["channel.seed=9"], seed=5)
    assert (scenario.channel.seed, scenario.sim.seed) == (9, 5)


def test_what_robots_share_stands_above_them_and_what_they_do_not_in_them() -> None:
    values = {**dump(BUILTIN["demo"]), "robots": [{}, {"publish": {"depth": 7}, "topics": []}], "repair": "thrifty"}
    one, other = scenario_from(values).robots
    assert (one.robot, other.robot) == ("/robot_1", "/robot_2")
    assert (one.publish.depth, other.publish.depth) == (1000, 7)
    assert (one.repair, other.repair) == ("thrifty", "thrifty")
    assert one.graph == other.graph
    told = dump(scenario_from(values))
    assert told["repair"] == "thrifty"
    assert [robot.get("publish", {}).get("depth") for robot in told["robots"]] == [1000, 7]
    assert all("graph" not in robot for robot in told["robots"])


def test_two_robots_that_send_hear_each_other_over_channels_of_their_own() -> None:
    scenario = load_scenario("two-way", ["channel.snr_db=20", "robots.1.publish.depth=7"], seed=5)
    here, other = scenario.all_robots
    assert all(robot.config.sends and robot.takes for robot in (here, other))
    assert (here.config.publish.depth, other.config.publish.depth) == (1000, 7)
    (there,), (back,) = here.paths, other.paths
    assert (there.receiver, back.receiver) == (1, 0)
    assert there.channel.snr_db == back.channel.snr_db == 20
    assert there.channel.burst_loss is None
    assert back.channel.burst_loss is not None
    assert back.channel.seed != there.channel.seed == 5


def test_a_part_is_changed_at_all_robots() -> None:
    for name in ("two-way", "team", "demo"):
        scenario = changed(BUILTIN[name], RobotConfig, lambda robot: replaced(robot, packet_len=99))
        assert {scenario.packet_len, *(robot.config.packet_len for robot in scenario.all_robots)} == {99}


def test_one_robot_of_a_list_is_changed_by_its_place() -> None:
    team = load_scenario("team", ["robots.2.packet_rate=5"])
    assert [robot.packet_rate for robot in team.robots] == ["auto", "auto", 5, "auto"]
    with pytest.raises(ConfigError, match=r"robots\.7 has no settings below it"):
        load_scenario("team", ["robots.7.packet_rate=5"])
    with pytest.raises(ConfigError, match="robots is a list; name a setting of one"):
        load_scenario("demo", ["robots.7=5"])


def test_override_values_are_yaml() -> None:
    assert parse_override("a.b = 2e5") == (("a", "b"), 200_000.0)
    assert parse_override("a=true") == (("a",), True)
    assert parse_override("a={b: 1}") == (("a",), {"b": 1})
    assert parse_override("a=bag: x=y") == (("a",), "bag: x=y")
    assert parse_override("a=") == (("a",), "")


@pytest.mark.parametrize(
    ("override", "says"),
    [
        ("foo=1", "unknown key foo; known are "),
        ("phy.foo=1", "unknown key phy.foo; known are name, sample_rate"),
        ("phy.sample_rate=-1", "phy.sample_rate = -1: write auto"),
        ("phy.sample_rate=-2", "phy.sample_rate = -2: must be greater than 0, or 'auto'"),
        ("packet_len=9", "^demo: packet_len = 9: [^;]*$"),
        ("seed=x", "^demo: seed = 'x': [^;]*$"),
        ("sim.robots=0", "sim.robots = 0"),
        ("robots.1.packet_len=64", "packet_len: all robots have to agree on it; set it above robots"),
        ("paper.min_fragment=999", "min_fragment = 999 does not fit packet_len = 220"),
        ("paper.hop=99", "paper.hop = 99"),
        ("graph.middleware=foo", "graph.middleware = 'foo': .* known are dds"),
        ("phy.name=foo", "phy.name = 'foo': .* known are direct, ofdm"),
        ("ros_source=5", "ros_source is no setting any more: write robot"),
        ("packet_len.x=4", "packet_len has no settings below it"),
        ("source=bag:", "the path of the bag is missing"),
        ("source=dds", "write sim or bag:PATH"),
        ("registry=nope", "registry = 'nope': no such file; built in are cameras, odom, rtk, search, table4"),
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
        ("back={}", "back is no setting any more: write robots"),
        ("reports={}", "reports is no setting any more: write robots"),
        ("receivers=[{}]", "receivers is no setting any more: write robots"),
        ("robots=5x", "robots = '5x': must be a list"),
        ("robots=0", "robots: 0 of them; a scenario has two or more"),
        ("robots=[{}, 5]", "robots.1 = 5: must be keys and values"),
        ("robots=[{}, {robot: /robot_1}]", "robots: two are robot 1; give each a number of its own"),
        ("robots=[{}, {colour: 1}]", "unknown key robots.1.colour; known are "),
        ("robots.1.graph={colour: 1}", "unknown key robots.1.graph.colour; known are middleware"),
        ("time=unthrottled", "time = 'unthrottled': must be 'real', 'samples' or 'packets'"),
        (".packet_len=1", "write key=value"),
    ],
)
def test_what_is_wrong_is_named(override: str, says: str) -> None:
    with pytest.raises(ConfigError, match=says) as caught:
        load_scenario("demo", [override])
    assert "\n" not in str(caught.value)


def test_what_the_papers_blocks_have_of_their_own_is_not_set_beside_them() -> None:
    with pytest.raises(ConfigError, match=r"compression = False: .* set paper\.compression"):
        load_scenario("paper-ofdm", ["compression=false"])


def test_a_recording_speaks_for_one_robot() -> None:
    with pytest.raises(ConfigError, match="robots: source = 'bag:here' speaks for one robot"):
        load_scenario("two-way", ["source=bag:here"])


def test_a_file_with_a_registry_beside_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "mine.csv").write_text("fix,sensor_msgs/NavSatFix\n")
    path = tmp_path / "field-trial.yaml"
    path.write_text("registry: mine.csv\nsource: bag:here\nduration_s: 0\nrobots: [{robot: 3}, {topics: []}]\n")
    scenario = load_scenario(path)
    assert (scenario.name, scenario.duration_s, scenario.bag_path) == ("field-trial", 0, Path("here"))
    assert [topic.name for topic in scenario.load_registry()] == ["fix"]
    monkeypatch.chdir(tmp_path)
    assert load_scenario("demo", ["registry=mine.csv"]).registry == str(tmp_path / "mine.csv")


def test_neither_a_file_nor_built_in() -> None:
    with pytest.raises(
        ConfigError, match=r"'dmeo' is neither a file nor built in; built in are cameras, .*paper-direct"
    ):
        load_scenario("dmeo")


def test_a_description_that_settings_contradict_is_made_from_them() -> None:
    assert load_scenario("team", ("time=packets", "seed=3")).description == "four robots on one channel, in slots"
    assert load_scenario("team", ("medium=exclusive", "phy.name=lora", "robots=3")).description == (
        "3 robots, lora at 200,000 samples/s, one channel, exclusive; "
        "team with medium=exclusive, phy.name=lora, robots=3"
    )
    silent = load_scenario("two-way", ("robots.1.topics=[]",), source="bag:mine").description
    assert silent.endswith("; two-way with robots.1.topics=[], source=bag:mine")
