"""`relay` of a scenario: what reaches robots that do not hear the sender, sealed and not, and over how many robots."""

from __future__ import annotations

from pathlib import Path

import pytest

from gr_ros2.core.errors import ConfigError
from gr_ros2.observe.result import TopicResult
from gr_ros2.state.keys import new_key_file
from gr_ros2_lab.record.result import Result
from gr_ros2_lab.record.team_numbers import team_numbers
from gr_ros2_lab.report.table import hops_grid
from gr_ros2_lab.run.scenario import load_scenario
from gr_ros2_lab.run.simulated_runner import run_simulated


def line(*overrides: str) -> Result:
    """`line` for 8 s, in which each robot sends 16 messages."""
    return run_simulated(load_scenario("line", overrides, duration_s=8)).result


def of_the_first(result: Result, robot: int) -> TopicResult:
    """The odometry of robot 1 at another one."""
    topics = result.receivers[robot - 2].topics
    return next(topic for topic in topics if topic.src_id == 1)


def test_messages_cross_three_hops_and_the_result_says_so() -> None:
    result = line()
    near, far = of_the_first(result, 2), of_the_first(result, 10)
    assert near.delivered >= 15
    assert near.hops["0"] >= 10
    assert far.delivered >= 12
    assert sum(far.hops.values()) == far.delivered
    assert min(far.hops) >= "2"
    grid = hops_grid(result)
    assert grid is not None
    ((heard, *over),) = grid.sections
    assert heard[0] == "0 (heard itself)"
    assert [line[0] for line in over[:2]] == ["1", "2"]
    assert sum(int(line[1]) for line in (heard, *over)) == 90
    assert 0.2 < (team_numbers(result)["relayed"] or 0) < 0.8


def test_without_relaying_nothing_crosses() -> None:
    result = line("relay='off'")
    assert of_the_first(result, 2).delivered >= 15
    assert {topic.src_id for topic in result.receivers[8].topics} == {7, 8, 9}
    assert hops_grid(result) is None


def test_sealed_messages_cross_three_hops(tmp_path: Path) -> None:
    new_key_file(tmp_path / "fleet.key")
    assert of_the_first(line(f"key={tmp_path / 'fleet.key'}"), 10).delivered >= 10


def test_relaying_needs_slots() -> None:
    with pytest.raises(ConfigError, match="relay = 'gain': the packets of slots name who hears whom"):
        load_scenario("line", ["medium=exclusive"])
