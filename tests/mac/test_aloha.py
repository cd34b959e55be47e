"""Limited ALOHA: the load of all robots, whoever is heard."""

from __future__ import annotations

import random

import pytest

from gr_ros2.mac import Aloha

AIRTIME = 1 / 75


def rate(heard_per_robot: float, robots: int) -> float:
    """Packets per s of a robot that hears each of some robots so often per packet of its own."""
    made, rng = Aloha(0, AIRTIME, random.Random(1), period_s=0.1), random.Random(2)
    now, sent = 0.0, 0
    while now < 300.0:
        now = made.departure(now)
        made.block()
        sent += 1
        for other in range(1, robots + 1):
            if rng.random() < heard_per_robot:
                made.hear(other, None, now)
    return sent / now


def test_all_robots_together_start_half_a_packet_in_one_airtime() -> None:
    assert rate(0.5, 19) * 20 * AIRTIME == pytest.approx(0.5, rel=0.15)


def test_it_sends_less_where_fewer_packets_come_through_than_should() -> None:
    assert rate(0.1, 19) < 0.5 * rate(0.5, 19)


def test_a_robot_sends_no_more_often_than_it_has_messages() -> None:
    assert rate(1.0, 1) <= 10.5
