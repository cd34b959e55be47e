"""Scenarios that speak version 1: repair, reports, further receivers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from gr_ros2.core.errors import ConfigError
from gr_ros2.link.fates import ARRIVED
from gr_ros2.observe.result import TopicResult
from gr_ros2.settings.files import find_registry
from gr_ros2_lab.record.result import Result, read_result, write_result
from gr_ros2_lab.report.table import ledger_grid, summary_grid
from gr_ros2_lab.run.runner import run_scenario
from gr_ros2_lab.run.scenario import Scenario, dump, load_scenario, scenario_from

LOSS = 0.2


REPORTING: list[dict[str, Any]] = [{}, {"topics": []}]
"""One that sends, and one that hears it and reports."""


def scenario(**settings: Any) -> Scenario:
    """Odometry at 35 Hz, compressed, over the paper's OFDM link, which takes twice as many packets."""
    values = {
        "name": "odometry",
        "registry": find_registry("odom", Path()),
        "sim": {"odom_rate": 35},
        "packet_len": 64,
        "robots": [{"direction": "send"}, {"direction": "receive"}],
        "phy": {"name": "ofdm", "sample_rate": 100000, "options": {"detection_threshold": "stock"}},
        "channel": {"packet_loss": LOSS},
        "duration_s": 10.0,
        "time": "packets",
    }
    return scenario_from({**values, **settings})


def run(**settings: Any) -> Result:
    return run_scenario(scenario(**settings)).result


def checked(topic: TopicResult) -> TopicResult:
    assert not topic.corrupt
    assert sum(topic.ledger.get(fate, 0) for fate in ARRIVED) == topic.delivered
    return topic


def test_one_way_everything_comes_in_spite_of_losses() -> None:
    result = run()
    (odom,) = map(checked, result.topics)
    assert odom.pdr >= 0.99
    assert odom.ledger["repaired"] >= 0.1 * odom.sent
    packets = result.packets
    assert packets["air_new"] >= odom.sent
    assert packets["air_repair"] > 0.5 * packets["air_new"], "idle air carries repairs"
    assert packets["air_report"] == 0
    assert sum(packets[f"air_{kind}"] for kind in ("new", "repair", "report", "hello")) == packets["sent"]


def test_without_repair_what_is_lost_stays_lost() -> None:
    result = run(repair="off")
    (odom,) = map(checked, result.topics)
    assert 0.7 < odom.pdr < 0.9
    assert odom.ledger["lost_fragments"] > 0
    assert "given_up" not in odom.ledger


def test_reports_are_lost_too_and_save_air() -> None:
    one_way, reported = run(), run(robots=REPORTING, paths=[{"from": 2, "delay_s": 0.05}])
    (odom,) = map(checked, reported.topics)
    assert odom.pdr >= 0.99
    assert reported.packets["air_report"] > 0
    assert reported.packets["air_repair"] < one_way.packets["air_repair"]
    nothing_lost = run(robots=REPORTING, channel={})
    assert nothing_lost.topics[0].pdr == 1
    assert nothing_lost.packets["air_repair"] == 0


def test_a_way_back_that_loses_everything_is_none() -> None:
    (odom,) = map(checked, run(robots=REPORTING, paths=[{"from": 2, "packet_loss": 1.0}]).topics)
    assert odom.pdr >= 0.95


def test_every_receiver_has_losses_of_its_own(tmp_path: Path) -> None:
    result = run(robots=[*REPORTING, {"topics": []}, {"topics": []}], paths=[{"from": 1, "to": 4, "packet_loss": 0.4}])
    assert [receiver.number for receiver in result.receivers] == [2, 3]
    every = [result.topics[0], *(topic for receiver in result.receivers for topic in receiver.topics)]
    assert [checked(topic).pdr >= 0.97 for topic in every] == [True] * 3
    repaired = [topic.ledger["repaired"] for topic in every]
    assert len(set(repaired)) == 3
    assert repaired[2] > 1.3 * repaired[0]
    again = read_result(write_result(result, tmp_path / "result.json"))
    assert again.receivers == result.receivers
    names = [line[0] for line in summary_grid([again]).sections[0]]
    assert names == [f"/robot_1/odom at receiver {number}" for number in (1, 2, 3)]
    assert [line[0] for line in ledger_grid(again).sections[0]] == names


def test_both_ways_at_once() -> None:
    both = run(
        registry=find_registry("table4", Path()),
        packet_len=220,
        sim={"robots": 2, "odom_rate": 20, "imu_rate": 20, "scan_rate": 1, "map_cells": 40},
        phy={"name": "ofdm", "sample_rate": 2_000_000, "options": {"detection_threshold": "stock"}},
        robots=[{"topics": ["odom", "imu"]}, {"topics": ["odom"]}],
        duration_s=5.0,
    )
    assert {topic.topic for topic in both.topics} == {"/robot_1/odom", "/robot_1/imu", "/robot_2/odom"}
    assert all(checked(topic).pdr >= 0.98 for topic in both.topics)
    assert both.packets["air_report"] > 0


@pytest.mark.slow
def test_through_the_flowgraph_too() -> None:
    (odom,) = map(checked, run(time="samples", robots=REPORTING, duration_s=1.0).topics)
    assert odom.pdr >= 0.9


@pytest.mark.parametrize("delay_s", [0.0, 0.05])
def test_without_a_pace_reports_still_repair(delay_s: float) -> None:
    direct: dict[str, Any] = {
        "phy": {"name": "direct"},
        "robots": REPORTING,
        "paths": [{"from": 2, "delay_s": delay_s}],
    }
    result = run(**direct)
    (odom,) = map(checked, result.topics)
    assert odom.pdr == 1
    assert odom.ledger["repaired"] > 0
    assert odom.latency_s.p99 is not None
    assert odom.latency_s.p99 >= delay_s, "a repair waits for the report"
    assert result.packets["air_repair"] < odom.sent
    assert run(**direct, channel={}).packets["air_repair"] == 0
    assert run(phy={"name": "direct"}).packets["air_repair"] == 0, "nobody says what is lost"


def test_paths_take_over_what_is_not_set_but_the_seed() -> None:
    made = scenario(robots=[*REPORTING, {"topics": []}], paths=[{"from": 1, "to": 3, "packet_loss": 0.5}], seed=3)
    assert made.reports
    paths = [path.channel for robot in made.all_robots for path in robot.paths]
    assert [path.packet_loss for path in paths] == [LOSS, 0.5, LOSS, LOSS]
    assert len({path.seed for path in paths}) == 4
    assert scenario_from(dump(made)) == made


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"packet_len": 30}, "packet_len = 30: robots need at least 40"),
        ({"version": 1}, "version is no setting any more"),
        ({"back": {}}, "back is no setting any more: write robots"),
        ({"paths": [{"from": 7}]}, "paths: there is no robot 7; there are 1, 2"),
        ({"robots": [{"topics": []}, {}]}, "name those that send first"),
        ({"robots": [{"topics": []}, {"direction": "receive"}]}, "none sends anything"),
        ({"robots": [{}, {"packet_len": 80}]}, "packet_len: all robots have to agree on it; set it above robots"),
    ],
)
def test_what_does_not_go_together_is_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        scenario(**settings)


def test_a_run_in_which_messages_wait_for_their_turn_comes_to_its_end() -> None:
    setting = "topics={odom: {max_rate: 5}}"
    values = load_scenario("demo", [setting], time="packets", duration_s=1.0)
    result = run_scenario(values).result
    assert all(topic.delivered for topic in result.topics if topic.topic in ("odom", "scan"))
