"""Tasks of robots on what they hear: commands from places, places from messages, and errors that name the task."""

from __future__ import annotations

import math
import random
import struct
from collections.abc import Mapping

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gr_ros2.core.errors import ConfigError
from gr_ros2_lab.sim.motion import State
from gr_ros2_lab.sim.sensors import read_command, read_odometry, write_command
from gr_ros2_lab.sim.sim_settings import SimSettings
from gr_ros2_lab.sim.tasks import Command, Formation, LastHeard, Rendezvous, Task, TaskRobots, make_task, towards

QUIET = SimSettings(odom_noise=(0, 0), odom_rate=10)


class OnlyAhead(Task):
    """A task as a user writes it."""

    def start(self, number: int) -> State:
        return State(0.0, 3.0 * number, 0.0, 0.0, 0.0)

    def command(self, number: int, now: float, own: State, heard: Mapping[int, LastHeard]) -> Command:  # noqa: ARG002
        return float(number), 0.0


def together(task: Task, seconds: float) -> dict[str, float | None]:
    """How well a task is done where every message arrives everywhere at once."""
    robots = TaskRobots(task, QUIET)
    for at, sender in sorted((at, n) for n in range(task.robots) for at in robots.times(n, seconds)):
        payload = robots.odometry(sender, at)
        for other in range(task.robots):
            if other != sender:
                robots.heard(other, sender, payload, at)
    robots.advance(seconds)
    return robots.numbers()


def test_an_odometry_says_where_its_robot_was() -> None:
    robots = TaskRobots(OnlyAhead(3, random.Random(1)), QUIET)
    made_ns, state = read_odometry(robots.odometry(2, 3.05))
    assert made_ns == 3_050_000_000
    # It speeds up by 1 m/s² to 2 m/s.
    assert state[:5] == pytest.approx((2.0 + 1.05 * 2.0, 6.0, 0.0, 2.0, 0.0), abs=1e-6)


def test_a_robot_heard_before_is_where_it_would_be_now() -> None:
    heard = LastHeard(10.0, State(1.0, 2.0, math.pi / 2, 2.0, 0.0))
    assert heard.at(10.25)[:2] == pytest.approx((1.0, 2.5))
    assert heard.at(9.0)[:2] == (1.0, 2.0)


def test_an_older_message_does_not_replace_a_newer_one() -> None:
    robots = TaskRobots(OnlyAhead(2, random.Random(1)), QUIET)
    older, newer = robots.odometry(1, 1.0), robots.odometry(1, 2.0)
    robots.heard(0, 1, newer, 2.1)
    robots.heard(0, 1, older, 2.2)
    assert robots._heard[0][1].made_s == pytest.approx(2.0)


def test_who_hears_keeps_its_place_and_who_does_not_stays() -> None:
    heard = together(Formation(5, random.Random(1)), 40)["formation_error_m"]
    assert heard is not None
    assert heard < 0.5
    deaf = TaskRobots(Formation(5, random.Random(1)), QUIET)
    deaf.advance(40)
    assert (deaf.numbers()["formation_error_m"] or 0) > 10 * heard


def test_robots_meet_where_they_hear_each_other_alone() -> None:
    numbers = together(Rendezvous(6, random.Random(1)), 60)
    assert numbers["met"] == 1
    deaf = TaskRobots(Rendezvous(6, random.Random(1)), QUIET)
    deaf.advance(60)
    assert deaf.numbers() == {"time_to_meet_s": 60, "met": 0}


def test_robots_follow_commands_as_far_as_they_can() -> None:
    assert towards(State(0, 0, 0, 0, 0), 3.0, 0.0, 2.0) == (2.0, 0.0)
    assert towards(State(0, 0, 0, 0, 0), -3.0, 0.1, 2.0)[0] == 0, "it turns first"
    assert towards(State(0, 0, 0, 0, 0), 0.0, 0.0, 2.0) == (0.0, 0.0)


def test_a_robot_does_what_its_controller_says_for_as_long_as_it_says_so() -> None:
    robots = TaskRobots(OnlyAhead(2, random.Random(1)), QUIET, commanded=[0])
    robots.advance(1.0)
    assert [read_odometry(robots.odometry(n, 1.0))[1].speed for n in (0, 1)] == pytest.approx([0, 1])
    for at in (1.0, 1.2, 1.4):
        robots.advance(at)
        robots.follow(0, (0.3, 0.1), at)
    assert read_odometry(robots.odometry(0, 1.8))[1][3:5] == pytest.approx((0.3, 0.1))
    assert read_odometry(robots.odometry(0, 2.9))[1][3:5] == pytest.approx((0.0, 0.0))


@given(st.floats(allow_nan=False, allow_infinity=False), st.floats(allow_nan=False, allow_infinity=False))
def test_commands_are_read_as_written(speed: float, turn: float) -> None:
    payload = write_command(speed, turn)
    swapped = b"\0\0\0\0" + struct.pack(">6d", *struct.unpack("<6d", payload[4:]))
    assert read_command(payload) == read_command(swapped) == (speed, turn)


@given(st.binary(max_size=60))
def test_what_is_no_command_is_none(payload: bytes) -> None:
    command = read_command(payload)
    assert command is None or (len(payload) >= 52 and all(map(math.isfinite, command)))
    assert read_command(write_command(math.nan, 0.0)) is None


def test_a_task_of_a_users_module_stands_in() -> None:
    assert isinstance(make_task(f"{__name__}:OnlyAhead", 2, 1), Task)


@pytest.mark.parametrize("name", ["dance", "no_such_module:Task", f"{__name__}:QUIET", f"{__name__}:None_"])
def test_what_is_no_task_is_named(name: str) -> None:
    with pytest.raises(ConfigError, match="task = "):
        make_task(name, 2, 1)
