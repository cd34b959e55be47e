"""What is said of a measurement over several radios, of which some may fail."""

from __future__ import annotations

from typing import Any

import pytest

from gr_ros2.core.errors import ConfigError
from gr_ros2.gr.throughput import MAIN, ThroughputWays


class MeasuredWay:
    """Stands for what is measured over one way.

    :param robots: those that are heard
    """

    def __init__(self, *robots: int, state: str = "done", words: str = "") -> None:
        self.robots, self.state, self.words = robots, state, words
        self.asked: list[tuple[int, int]] = []

    def hears(self, robot: int) -> bool:
        return robot in self.robots

    def check(self, robot: int, _for_s: int) -> None:
        if robot not in self.robots:
            raise ConfigError(f"robot {robot} is not heard")
        if self.state == "busy":
            raise ConfigError("goes on")

    def measure(self, robot: int, for_s: int) -> None:
        self.asked.append((robot, for_s))

    def look(self) -> dict[str, Any]:
        way = {"messages": 7}
        return {"robot": 2, "state": self.state, "words": self.words, "for_s": 5, "there": way, "back": way}


def told(**ways: MeasuredWay) -> dict[str, Any]:
    every: Any = {name.replace("main", MAIN): way for name, way in ways.items()}
    measurements = ThroughputWays(lambda: every)
    measurements.measure(2, 5)
    return measurements.look()


def test_all_over_which_the_robot_is_heard_are_measured() -> None:
    ways = {"main": MeasuredWay(2, 3), "far": MeasuredWay(2), "other": MeasuredWay(3)}
    said = told(**ways)
    assert [way.asked for way in ways.values()] == [[(2, 5)], [(2, 5)], []]
    assert (said["there"], list(said["radios"])) == ({"messages": 7}, ["far"])


def test_a_robot_that_has_only_the_shared_radio_is_measured_there() -> None:
    said = told(main=MeasuredWay(3), far=MeasuredWay(2))
    assert (said["state"], said["there"], said["radios"]["far"]["there"]) == ("done", None, {"messages": 7})


def test_who_is_not_heard_is_refused_and_nothing_begins() -> None:
    with pytest.raises(ConfigError, match="not heard"):
        told(main=MeasuredWay(3), far=MeasuredWay(3))
    main = MeasuredWay(2)
    with pytest.raises(ConfigError, match="goes on"):
        told(main=main, far=MeasuredWay(2, state="busy"))
    assert main.asked == []


@pytest.mark.parametrize(
    ("main", "far", "state"),
    [
        ("done", "there", "there"),
        ("failed", "back", "back"),
        ("failed", "done", "done"),
        ("failed", "failed", "failed"),
    ],
)
def test_it_ends_with_the_last_way_and_fails_if_each_does(main: str, far: str, state: str) -> None:
    said = told(
        main=MeasuredWay(2, state=main, words="no answer" if main == "failed" else ""), far=MeasuredWay(2, state=far)
    )
    assert said["state"] == state
    assert said["words"] == ("no answer" if main == "failed" else "")
