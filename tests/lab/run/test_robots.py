"""Scenarios made of robots: two on one channel, many, and what lies between them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from gr_ros2.core.errors import ConfigError
from gr_ros2.settings.config import replaced
from gr_ros2_lab.medium import Surroundings
from gr_ros2_lab.record.result import Result, read_result, write_result
from gr_ros2_lab.report.table import summary_grid
from gr_ros2_lab.run.recorders import receivers_of
from gr_ros2_lab.run.robots import surroundings
from gr_ros2_lab.run.runner import run_scenario
from gr_ros2_lab.run.scenario import dump, load_scenario, scenario_from
from tests.e2e.support import check_books


def run(name: str, *overrides: str, **settings: Any) -> Result:
    result = run_scenario(load_scenario(name, overrides, **settings)).result
    check_books(result)
    return result


@pytest.mark.parametrize("time", ["packets", "samples"])
def test_two_robots_on_one_channel_disturb_each_other_and_repair_it(time: str) -> None:
    result = run("two-robots-half-duplex", f"time={time}", duration_s=5.0)
    assert {topic.topic for topic in result.topics} == {"/robot_1/odom", "/robot_2/odom"}
    assert result.counters["channel"]["sending"] > 0
    assert result.phy["channels"] == 1
    assert all(topic.delivered for topic in result.topics)
    apart = run("two-robots-half-duplex", f"time={time}", "duplex=full", duration_s=5.0)
    assert "sending" not in apart.counters["channel"]
    assert [topic.pdr for topic in apart.topics] == [1.0, 1.0]
    assert apart.phy["channels"] == 2


def test_twenty_robots_have_a_table_each(tmp_path: Path) -> None:
    result = run("twenty-robots", "medium=exclusive", duration_s=2.0)
    assert len(result.topics) == 19
    assert [receiver.name for receiver in result.receivers] == [f"/robot_{number}" for number in range(2, 21)]
    assert {len(receiver.topics) for receiver in result.receivers} == {19}
    for receiver in result.receivers:
        assert 0 < receiver.packets["received"] < receiver.packets["sent"]
        assert receiver.phy["channels"] == 1
        assert receiver.phy["bytes_per_message"] > 0
    assert len({receiver.packets["received"] for receiver in result.receivers}) > 1
    assert result.counters["channel"]["collision"] > 0
    assert sum(topic.delivered for topic in result.topics) > 0
    again = read_result(write_result(result, tmp_path / "result.json"))
    assert again.receivers == result.receivers
    assert "/robot_3/odom at /robot_2" in [line[0] for line in summary_grid([again]).sections[0]]


def levels(around: Surroundings) -> list[list[tuple[int, float]]]:
    """The hearers of every robot, and their SNRs."""
    heard = [around.hearers(number, 0.0) for number in range(around.robots)]
    return [list(zip(one.ids.tolist(), one.snr_db.tolist(), strict=True)) for one in heard]


def test_levels_follow_from_power_gain_and_noise() -> None:
    rows = "[[null, -100, null], [-110, null, -90], [null, -200, null]]"
    louder = "robots=[{}, {tx_power_dbm: 30}, {noise_figure_db: 3}]"
    scenario = load_scenario("two-robots-half-duplex", [louder, f"gains_db={rows}"])
    around = surroundings(scenario, 1e6)
    noise_dbm = -174 + 60 + 6
    assert levels(around) == [
        [(1, 20 - 100 - noise_dbm)],
        [(0, 30 - 110 - noise_dbm), (2, 30 - 90 - noise_dbm + 3)],
        [],  # 20 - 200 dBm is below what anybody hears
    ]
    assert receivers_of(scenario, around) == {0: [1], 1: [0], 2: [1]}
    assert len({around.path(*pair).channel.seed for pair in ((0, 1), (1, 0), (1, 2))}) == 3
    assert scenario_from(dump(scenario)) == scenario


ONE_WAY = [
    *("phy.sample_rate=1e6", "time=packets", "paths=[{to: 3, packet_loss: 0.5}]"),
    "robots=[{}, {topics: []}, {direction: receive}]",
]


def test_robots_that_only_receive_have_levels_too() -> None:
    """20 dBm over a gain, and noise of -174 dBm/Hz at a noise figure of 6 dB."""
    rows = "[[null, -100, -110], [-120, null, -90], [null, null, null]]"
    scenario = load_scenario("demo", [*ONE_WAY, f"gains_db={rows}"])
    noise_dbm = -174 + 60 + 6
    around = surroundings(scenario, 1e6)
    assert levels(around) == [[(1, 20 - 100 - noise_dbm), (2, 20 - 110 - noise_dbm)], [(0, 20 - 120 - noise_dbm)], []]
    assert around.path(0, 2).channel.packet_loss == 0.5
    assert receivers_of(scenario, around) == {1: [0], 2: [0]}
    both = surroundings(load_scenario("two-way", ["gains_db=-105", "time=packets"]), 1e6)
    assert levels(both) == [[(1, 20 - 105 - noise_dbm)], [(0, 20 - 105 - noise_dbm)]]
    with pytest.raises(ConfigError, match="3 robots need 3 rows of 3 numbers"):
        load_scenario("demo", [*ONE_WAY, "gains_db=[[0, 1], [1, 0]]"])


@pytest.mark.parametrize("time", ["packets", "samples"])
@pytest.mark.parametrize(
    ("name", "change"), [("demo", "robots=[{direction: send}, {direction: receive}]"), ("two-way", "paths=[]")]
)
def test_what_arrives_one_way_and_two_ways_follows_from_the_gain(name: str, change: str, time: str) -> None:
    own = ["phy.sample_rate=200000", f"time={time}", "channel.packet_loss=0", 'repair="off"']
    own += [change, "topics=[odom]"]
    near, far = (run(name, *own, f"gains_db={gain}", duration_s=3.0) for gain in (-60, -133))
    assert [topic.pdr for topic in near.topics] == [1.0] * len(near.topics)
    assert all(topic.delivered == 0 for topic in far.topics)
    assert far.counters["channel"]["phy"] > 0


@pytest.mark.real_time
def test_in_real_time_too_and_who_hears_nobody_gets_nothing() -> None:
    rows = "gains_db=[[null, -90, null], [-90, null, null], [null, null, null]]"
    three = "robots=[{}, {topics: []}, {topics: []}]"
    result = run("demo", three, rows, "channel.packet_loss=0", "phy.sample_rate=200000", duration_s=2.0)
    assert all(topic.delivered for topic in result.topics if topic.sent)
    assert not any(topic.delivered for receiver in result.receivers for topic in receiver.topics)


def test_without_gains_the_snr_is_that_of_the_channel() -> None:
    scenario = load_scenario("two-robots-half-duplex", ["gains_db=null", "channel.snr_db=7"])
    assert levels(surroundings(scenario, 1e6)) == [[(1, 7)], [(0, 7)]]


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("robots=1", "two or more"),
        ("robots=[{}, {robot: /robot_1}]", "two are robot 1"),
        ("gains_db=[[1, 2]]", "2 robots need 2 rows of 2 numbers"),
        ("robots=null", "must be a list"),
        ("receivers=[{}]", "receivers is no setting any more"),
    ],
)
def test_what_does_not_go_together_is_refused(override: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        load_scenario("two-robots-half-duplex", [override])


def test_the_losses_at_levels_from_positions_can_be_measured() -> None:
    scenario = load_scenario("demo-team")
    channel = surroundings(scenario, 2e5).path(0, 1).channel
    assert replaced(channel, snr_db=2.5).snr_db == 2.5
