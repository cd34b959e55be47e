"""Robots that act on what comes out of their links, in simulated time; and the numbers of the team."""

from __future__ import annotations

import math
import subprocess
import sys
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from gr_ros2.core.errors import ConfigError, RunError
from gr_ros2_lab.record.result import Result
from gr_ros2_lab.record.team_numbers import TEAM_VALUES, team_numbers
from gr_ros2_lab.run.outcome import Progress
from gr_ros2_lab.run.runner import run_scenario
from gr_ros2_lab.run.scenario import load_scenario
from gr_ros2_lab.run.simulated_runner import run_simulated
from gr_ros2_lab.sim.motion import State
from gr_ros2_lab.sim.tasks import Command, LastHeard, Rendezvous, Task
from gr_ros2_lab.sim.world import World
from tests.docs.pages import blocks

PROGRAMS = [block for block in blocks("python") if block.page.endswith("teams.md")]
"""A task of one's own, and a node that drives a robot."""


class Near(Rendezvous):
    """Robots that need not go far."""

    SIDE_M = 8.0


class Behind(Task):
    """Robot 1 stands before a box, robot 2 drives from its side until it is behind it, out of sight."""

    world = World(20.0, 1, np.random.default_rng([1, 0]))

    def start(self, number: int) -> State:
        x, y, *_ = self.world.boxes[0]
        return State(x + (2 * number - 1) * 2, y - 6 * number, math.pi / 2, 0.0, 0.0)

    def command(self, number: int, now: float, own: State, heard: Mapping[int, LastHeard]) -> Command:  # noqa: ARG002
        self.newest = heard[1] if not number and 1 in heard else getattr(self, "newest", None)
        return (0.0 if not number or own.y >= self.world.boxes[0, 1] else 1.0), 0.0

    def numbers(self) -> dict[str, float | None]:
        return {"last_heard_s": self.newest and self.newest.made_s, "was_at_m": self.newest and self.newest.state.y}


class Nodes:
    """The node of the documentation for each of two robots, started as soon as the run names the graphs."""

    def __init__(self, folder: Path) -> None:
        self._program = folder / "meet.py"
        self._program.write_text(PROGRAMS[1].text)
        self.processes: list[subprocess.Popen[bytes]] = []

    def __call__(self, progress: Progress) -> None:
        if not self.processes:
            for robot, (_, domain) in enumerate(progress.graphs, 1):
                arguments = [str(domain), f"/robot_{robot}", f"/rx_robot_{3 - robot}"]
                self.processes.append(subprocess.Popen([sys.executable, str(self._program), *arguments]))

    def close(self) -> None:
        for process in self.processes:
            process.kill()
            process.wait()


def result(name: str, *overrides: str) -> Result:
    return run_simulated(load_scenario(name, overrides)).result


@pytest.mark.slow
def test_followers_keep_their_places_by_the_link_alone() -> None:
    slots = result("formation", "robots=3", "duration_s=20")
    nothing = result("formation", "robots=3", "duration_s=20", "channel.packet_loss=1")
    assert slots.task["formation_error_m"] < 1 < nothing.task["formation_error_m"]  # type: ignore[operator]
    assert result("formation", "robots=3", "duration_s=20").task == slots.task


@pytest.mark.slow
def test_robots_meet_in_slots_and_not_where_nothing_arrives() -> None:
    met = result("rendezvous", "robots=3", "duration_s=30")
    assert met.task["met"] == 1
    assert met.duration_s == pytest.approx(met.task["time_to_meet_s"], abs=0.1), "their meeting ends the run"
    assert all(sum(topic.ledger.values()) == topic.sent > 0 for topic in met.topics)
    alone = result("rendezvous", "robots=3", "duration_s=30", "channel.packet_loss=1")
    assert alone.task == {"time_to_meet_s": pytest.approx(30), "met": 0}


@pytest.mark.parametrize("walls_db", [0, 100])
def test_a_robot_that_drives_behind_a_wall_is_heard_no_more(walls_db: float) -> None:
    settings = "robots=2", "duration_s=10", "gains_db=null", "sim.obstacles=1", f"task={__name__}:Behind"
    channel = f"channel={{from: positions, walls_db: {walls_db}, tx_power_dbm: 0, noise_figure_db: 6}}"
    ran = result("formation", *settings, channel)
    x, y, *_ = Behind.world.boxes[0]
    here, there = np.array([x - 2, y]), np.array([[x + 2, ran.task["was_at_m"]]])
    assert ((ran.task["last_heard_s"] or 0) > 9.5) == (not walls_db)
    if walls_db:
        step = np.array([0.0, 0.3])
        assert Behind.world.crossed(here, there - step) == 0 < Behind.world.crossed(here, there + step)


def test_the_numbers_of_a_team_are_those_of_its_pairs() -> None:
    ran = result("team", "duration_s=5", "time=packets")
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
    (tmp_path / "mine.py").write_text(PROGRAMS[0].text)
    monkeypatch.syspath_prepend(tmp_path)
    settings = "robots=3", "duration_s=15", "packet_rate=1"
    careful, usual = (result("formation", *settings, task).task for task in ("task=mine:Careful", "task=formation"))
    assert careful["formation_error_m"] != usual["formation_error_m"]


@pytest.mark.slow
@pytest.mark.real_time
@pytest.mark.parametrize("controller", ["task", "ros"])
def test_robots_meet_in_real_time_whoever_drives_them(tmp_path: Path, controller: str) -> None:
    settings = ["robots=2", "time=real", "duration_s=4", f"task={__name__}:Near", f"controller={controller}"]
    settings += ["gains_db=null", "channel={from: positions, walls_db: 6, tx_power_dbm: 0, noise_figure_db: 6}"]
    with closing(Nodes(tmp_path)) as nodes:
        ran = run_scenario(load_scenario("rendezvous", settings), on_progress=nodes if controller == "ros" else None)
    assert ran.result.task["met"] == 1
    assert 0 < (ran.result.task["time_to_meet_s"] or 0) <= 4
    driven = {f"/robot_{robot}/cmd_vel" for robot in (1, 2)} if controller == "ros" else set()
    assert ran.result.counters["commands"].keys() == driven


def test_a_run_without_controllers_says_where_they_are_missed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gr_ros2_lab.run.runner._CONTROLLERS_S", 0.1)
    scenario = load_scenario("formation", ["robots=2", "time=real", "controller=ros"])
    with pytest.raises(RunError, match=r"nobody publishes /robot_2/cmd_vel within 0\.1 s; start the controllers"):
        run_scenario(scenario)


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        (["time=samples"], "task = 'formation'"),
        (["registry=table4", "topics=auto"], "their odometry|send their odometry alone"),
        (["task=dance"], "task = 'dance': is no task"),
        (["task=dance", "time=samples"], "task = 'dance': is no task"),
        (["controller=ros"], "controller = 'ros'"),
        (["task=", "time=real", "controller=ros"], "controller = 'ros'"),
    ],
)
def test_what_does_not_go_together_is_said(overrides: list[str], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        result("formation", "robots=3", "duration_s=1", *overrides)
