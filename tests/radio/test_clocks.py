"""Clocks of other robots: who is asked when, what was set, and what chrony is given."""

from __future__ import annotations

import socket
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")

from gr_ros2.core.errors import ConfigError
from gr_ros2.link.clocks import ClockOffset
from gr_ros2.radio.clocks import MAGIC, SAID_S, SAMPLE, ClockWatch
from gr_ros2.settings.config import ClockConfig, build


class Robots:
    """Robots that are asked, and a clock of the wall that can be set."""

    def __init__(self, *, mine: bool = False, **settings: Any) -> None:
        self.asked: list[tuple[int, float]] = []
        self.now, self.set_by_s, self.jumps, self.error_s = 0.0, 0.0, 0, 0.02
        self.heard: list[dict[str, Any]] = []
        self.walls: list[float] = []
        self.watch = ClockWatch(
            build(ClockConfig, settings),
            mine=mine,
            heard=lambda _: self.heard,
            ask=lambda robot: self.asked.append((robot, self.now)),
            set_wall=self.walls.append,
            ahead=lambda: 1e9 + self.set_by_s,
        )

    def look(self, now: float, *robots: int, hops: int = 0) -> None:
        """All that was asked has been answered 0.125 s ago."""
        self.now = now
        clock = ClockOffset(0.2, 0.01, self.jumps, -3.0, len(self.asked), 0.25, self.error_s, 0.125)._asdict()
        told = clock if self.asked else None
        self.heard = [{"robot": robot, "clock": told, "hops": hops, "silent": False} for robot in robots]
        self.watch.look(now)


@pytest.mark.parametrize(
    ("settings", "every_s"),
    [({}, 0), ({"mine": True}, 10), ({"every_s": 3}, 3), ({"chrony": "/none", "robot": 2}, 1)],
)
def test_robots_are_asked_as_often_as_somebody_needs_it(settings: Any, every_s: float) -> None:
    robots = Robots(**settings)
    for step in range(61):
        robots.look(step / 2, 2, 5)
    assert len(robots.asked) == (2 * (30 // every_s + 1) if every_s else 0)


def test_a_robot_that_is_reached_over_others_is_not_asked() -> None:
    robots = Robots(every_s=1)
    robots.look(0.0, 2, hops=1)
    assert robots.asked == []


def test_a_clock_that_was_set_is_said_for_a_while() -> None:
    robots = Robots()
    robots.asked.append((2, 0.0))
    robots.look(0.0, 2)
    assert robots.watch.lines(0.0) == []
    robots.set_by_s, robots.jumps = 7.5, 1
    robots.look(1.0, 2)
    own, other = robots.watch.lines(1.0)
    assert own.startswith("this computer's clock was set 7.5 s forward")
    assert other.startswith("the clock of robot 2 was set 3 s back")
    robots.look(2.0, 2)
    assert robots.watch.lines(1.0 + SAID_S) == []
    assert robots.walls == [1e9, 1e9 + 7.5, 1e9 + 7.5], "the endpoint is told"


def test_a_link_whose_clock_is_simulated_says_nothing_of_clocks() -> None:
    def fails(*_: object) -> float:
        raise AssertionError

    watch = ClockWatch(
        build(ClockConfig, {"every_s": 1}), mine=False, heard=fails, ask=fails, set_wall=fails, ahead=None
    )
    watch.look(0.0)
    watch.look(12.0)
    assert watch.lines(12.0) == []


def test_chrony_gets_each_answer_once_and_may_start_later(tmp_path: Path) -> None:
    path = tmp_path / "chrony.sock"
    robots = Robots(chrony=str(path), robot=2)
    robots.look(0.0, 2, 3)
    robots.look(0.5, 2, 3)
    assert robots.watch.given == 0, "nobody is there"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as chrony:
        chrony.bind(str(path))
        robots.look(1.25, 2, 3)
        robots.look(1.5, 2, 3)
        seconds, us, ahead_s, pulse, leap, _, magic = SAMPLE.unpack(chrony.recv(SAMPLE.size + 1))
        assert (seconds, us, ahead_s, pulse, leap, magic) == (10**9 + 1, 375_000, 0.25, 0, 0, MAGIC)
        chrony.setblocking(False)
        with pytest.raises(BlockingIOError):
            chrony.recv(SAMPLE.size)
        robots.error_s = 6.0
        robots.look(2.25, 2, 3)
        with pytest.raises(BlockingIOError):  # the other robot was frozen before it answered
            chrony.recv(SAMPLE.size)
        robots.error_s = 0.02
    path.unlink()
    for now in (3.25, 3.75):
        robots.look(now, 2)
    assert robots.watch.given == 1
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as again:
        again.bind(str(path))
        for now in (5.0, 5.5):
            robots.look(now, 2)
        assert len(again.recv(SAMPLE.size)) == SAMPLE.size == 40
    robots.watch.close()


@pytest.mark.parametrize("settings", [{"chrony": "/a"}, {"robot": 3}, {"chrony": "/a", "robot": 3, "every_s": 0}])
def test_what_does_not_go_together_is_refused(settings: Any) -> None:
    with pytest.raises(ConfigError, match="chrony"):
        build(ClockConfig, settings)
