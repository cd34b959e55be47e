"""Robots that act on what comes out of their links, in simulated time; and the numbers of the team."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")

from gr_ros2.core.errors import ConfigError
from gr_ros2.record.result import Result
from gr_ros2.record.team_numbers import TEAM_VALUES, team_numbers
from gr_ros2.run.scenario import load_scenario
from gr_ros2.run.simulated_runner import run_simulated
from tests.docs.pages import blocks


def result(name: str, *overrides: str) -> Result:
    return run_simulated(load_scenario(name, overrides)).result


def test_followers_keep_their_places_by_the_link_alone() -> None:
    slots = result("formation", "robots=3", "duration_s=20")
    nothing = result("formation", "robots=3", "duration_s=20", "channel.packet_loss=1")
    assert slots.task["formation_error_m"] < 1 < nothing.task["formation_error_m"]  # type: ignore[operator]
    assert result("formation", "robots=3", "duration_s=20").task == slots.task


@pytest.mark.slow
def test_robots_meet_in_slots_and_not_where_nothing_arrives() -> None:
    assert result("rendezvous", "robots=3", "duration_s=30").task["met"] == 1
    alone = result("rendezvous", "robots=3", "duration_s=30", "channel.packet_loss=1")
    assert alone.task == {"time_to_meet_s": pytest.approx(30), "met": 0}


def test_the_numbers_of_a_team_are_those_of_its_pairs() -> None:
    ran = result("team", "duration_s=5", "time=packets", "channel={snr_db: 20}")
    numbers = team_numbers(ran)
    pairs = [topic for topics in (ran.topics, *(one.topics for one in ran.receivers)) for topic in topics]
    assert len(pairs) == 4 * 3
    assert numbers["pair_pdr"] == sum(topic.delivered for topic in pairs) / sum(topic.sent for topic in pairs)
    assert numbers["pair_age_peak_s"] == max(topic.age_s.peak or 0 for topic in pairs)
    assert 0.99 < (numbers["jain"] or 0) <= 1
    assert 0 < (numbers["air_use"] or 0) < 1
    assert numbers.keys() <= TEAM_VALUES.keys()
    assert team_numbers(result("paper-direct", "time=packets", "duration_s=1")) == {}


def test_the_controller_of_the_documentation_stands_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (page,) = [block for block in blocks("python") if block.page.endswith("teams.md")]
    (tmp_path / "mine.py").write_text(page.text)
    monkeypatch.syspath_prepend(tmp_path)
    settings = "robots=3", "duration_s=15", "ros_source.packet_rate=1"
    careful, usual = (result("formation", *settings, task).task for task in ("task=mine:Careful", "task=formation"))
    assert careful["formation_error_m"] != usual["formation_error_m"]


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        (["time=samples"], "task = 'formation'"),
        (["registry=table4"], "their odometry|send their odometry alone"),
        (["task=dance"], "task = 'dance': is no task"),
    ],
)
def test_what_does_not_go_together_is_said(overrides: list[str], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        result("formation", "robots=3", "duration_s=1", *overrides)
