"""What coded topics may count on of a channel."""

from __future__ import annotations

import pytest

from gr_ros2.settings.config import SendOptions
from tests.link.v1.air import Air, Robot, registry

CAMERA, ODOMETRY = range(2)


@pytest.mark.parametrize("turn_s", [0.004, 0.1, 1.0])
def test_the_rate_that_others_leave_is_a_mean_at_any_packet_length(turn_s: float) -> None:
    topics = registry(camera=SendOptions(), odom=SendOptions(queue="latest"))
    robot = Robot(1, topics, hears=False, repair="off", packet_s=lambda: turn_s)
    robot.end.frames.begin(CAMERA)
    now, free = 0.0, []
    for turn in range(600):
        if turn % 4 == 0:
            robot.end.messages.submit(ODOMETRY, bytes(20), now)
        robot.slot(now)
        now += turn_s
        if turn > 300:
            free.append(robot.end.frames.progress(CAMERA, now).rate)
    mean = sum(free) / len(free)
    assert 0.75 * mean < min(free)
    assert max(free) < 1.25 * mean


def test_a_key_frame_is_asked_for_when_its_timer_says() -> None:
    """Although nothing else is due: the sending thread sleeps until then."""
    camera, other = Robot(1, registry(camera=SendOptions())), Robot(2)
    air = Air(camera, other)
    air.run(1.5)
    assert other.end.next_departure(credited=True) > air.now + 0.03
    other.end.frames.lost(1, CAMERA)
    other.end.pace.credit()
    at = other.end.next_departure()
    assert at is not None
    assert at <= air.now + 0.02
    data = other.slot(max(at, air.now))
    assert data is not None
    camera.receive(data, at)
    assert camera.end.frames.asks(CAMERA) == 1
    again = other.end.next_departure(credited=True)
    assert again is not None
    assert again > at + 0.02, "it has been asked for"
