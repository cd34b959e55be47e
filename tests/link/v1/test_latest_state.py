"""Rare messages arrive although nothing follows: an e-stop, a mode; corrections of a base station for robots."""

from __future__ import annotations

import pytest

from gr_ros2.link.events import Delivered
from gr_ros2.link.queues import PublisherQos
from gr_ros2.settings.config import SendOptions
from gr_ros2.settings.registry import Registry, Topic
from tests.link.v1.air import Air, Robot

STRING = "std_msgs/msg/String"


def best_effort(robot: Robot) -> Robot:
    robot.end.messages.follow(0, PublisherQos(reliable=False, depth=1))
    return robot


def stopper(**options: float) -> Robot:
    return best_effort(Robot(1, Registry([Topic(0, "e_stop", STRING, SendOptions(**options))])))  # type: ignore[arg-type]


@pytest.mark.parametrize("loss", [0.3, 0.6])
def test_one_best_effort_message_arrives_although_nothing_follows(loss: float) -> None:
    for seed in range(10):
        one, two = stopper(), Robot(2)
        air = Air(one, two, loss=loss, seed=seed)
        air.run(5.0)
        one.end.messages.submit(0, b"stop", air.now)
        assert air.run(10.0, lambda: bool(two.delivered())) < 10.0  # noqa: B023 - called at once
        assert two.delivered() == [b"stop"]


@pytest.mark.parametrize("seed", [28, 60])
def test_a_late_report_about_what_was_repaired_does_not_delay_the_next_repairs(seed: int) -> None:
    """Reports of the start come after seconds, because they were lost, or the packets before them."""
    one, two = stopper(), Robot(2)
    air = Air(one, two, loss=0.6, seed=seed)
    air.run(5.0)
    one.end.messages.submit(0, b"stop", air.now)
    assert air.run(20.0, lambda: bool(two.delivered())) < 5.0


@pytest.mark.parametrize("seed", [1, 4, 7])
def test_a_message_every_minute_is_repaired_as_soon_as_any(seed: int) -> None:
    """Nothing is reported meanwhile, since nothing comes: that says nothing of how soon reports come."""
    one, two = stopper(), Robot(2)
    air = Air(one, two, loss=0.4, seed=seed)
    air.run(5.0)
    for n in range(30):
        text = b"stop %d" % n
        one.end.messages.submit(0, text, air.now)
        took = air.run(60.0, lambda: text in two.delivered())  # noqa: B023 - called at once
        assert took < 5.0
        air.run(60.0 - took)


@pytest.mark.parametrize(("keep_s", "away_s", "arrives"), [(0.0, 30.0, False), (60.0, 30.0, True), (20.0, 40.0, False)])
def test_keep_s_says_how_long_a_robot_out_of_range_can_still_get_it(
    keep_s: float, away_s: float, arrives: bool
) -> None:
    one, two = stopper(keep_s=keep_s), Robot(2)
    air = Air(one, two)
    air.run(3.0)
    air.lost = lambda _, __: True
    one.end.messages.submit(0, b"stop", air.now)
    air.run(away_s)
    assert two.delivered() == []
    air.lost = lambda _, __: False
    air.run(25.0)
    assert two.delivered() == ([b"stop"] if arrives else [])


def test_a_base_station_sends_corrections_to_robots_that_send_telemetry() -> None:
    """One full-duplex channel, a fifth of the packets lost; every robot has the newest correction within a second."""
    base = Robot(1, Registry([Topic(0, "rtcm", "rtcm_msgs/msg/Message", SendOptions(keep_s=10.0))]))
    rovers = [Robot(n, Registry([Topic(0, "fix", "sensor_msgs/msg/NavSatFix")])) for n in range(2, 6)]
    air = Air(base, *rovers, loss=0.2)
    air.run(3.0)
    late = 0
    for second in range(30):
        base.end.messages.submit(0, b"%03d" % second + bytes(180), air.now)
        for number, rover in enumerate(rovers):
            rover.end.messages.submit(0, b"%d %03d" % (number, second), air.now)
        air.run(1.0)
        late += sum(rover.delivered(1)[-1:] != [b"%03d" % second + bytes(180)] for rover in rovers)
    assert late <= 2, "of 120"
    heard = [event for event in base.events if isinstance(event, Delivered)]
    assert {event.src_id for event in heard} == {2, 3, 4, 5}
    assert len(heard) >= 0.98 * 120
