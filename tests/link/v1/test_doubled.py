"""Two robots under one number are named by everybody who hears both; a robot that restarts is not taken for two."""

from __future__ import annotations

import pytest

from gr_ros2.link.v1.sealing import SealMode
from tests.link.v1.air import Air, Robot, registry
from tests.link.v1.test_relaying import Line, robot

MODES = ["none", "authenticate", "encrypt"]


def doubled(robot: Robot, now: float) -> set[int]:
    return {peer.robot for peer in robot.end.peers(now) if peer.doubled}


def talk(air: Air, seconds: float, *senders: Robot) -> None:
    end = air.now + seconds
    while air.now < end:
        for sender in senders:
            sender.end.messages.submit(0, b"%.3f" % air.now, air.now)
        air.run(0.5)


@pytest.mark.parametrize("mode", MODES)
def test_who_hears_two_robots_of_one_number_names_it(mode: SealMode) -> None:
    one, other, third = (Robot(src_id, registry(), mode=mode, hears=True) for src_id in (1, 1, 2))
    one.start(boot=5 << 32 | 77)
    other.start(boot=6 << 32 | 78)
    air = Air(one, third)
    talk(air, 5.0, one)
    air.robots.append(other)
    air.invariant.robots = []  # it knows robots by their numbers
    air.lost = lambda sender, receiver: {sender, receiver} == {one, other}  # they are out of each other's reach
    talk(air, 40.0, one, other)
    assert doubled(third, air.now) == {1}
    air.robots.remove(one)
    talk(air, 100.0, other)
    assert not doubled(third, air.now), "one of them was switched off"


@pytest.mark.parametrize("mode", MODES)
def test_a_robot_that_restarts_again_and_again_is_one(mode: SealMode) -> None:
    one, two = Robot(1, registry(), mode=mode, hears=True), Robot(2, registry(), mode=mode, hears=True)
    air = Air(one, two, loss=0.1)
    for _ in range(5):
        talk(air, 6.0, one)
        assert not doubled(two, air.now)
        one.start()


class Shuffled(Air):
    """Packets are .53 s under way in the mean, and overtake each other."""

    def step(self) -> None:
        super().step()
        left, self.under_way[-1] = self.under_way[-1], []
        for packet in left:
            self.rng.choice(self.under_way).append(packet)


@pytest.mark.parametrize(("seed", "mode"), [(0, "none"), (1, "none"), (2, "authenticate"), (3, "encrypt")])
def test_a_robot_that_restarts_is_one_where_packets_overtake_each_other(mode: SealMode, seed: int) -> None:
    one, two = Robot(1, registry(), mode=mode, hears=True), Robot(2, registry(), mode=mode, hears=True)
    air = Shuffled(one, two, loss=0.1, seed=seed, delay=80)
    for _ in range(5):
        talk(air, 6.0, one)
        assert not doubled(two, air.now)
        one.start()


@pytest.mark.parametrize("mode", MODES[::2])
def test_who_reaches_two_robots_of_one_number_over_others_names_it(mode: SealMode) -> None:
    """1 - 2 - 3 - 4 - 1: robot 3 is two hops from both."""
    line = Line(*(robot(src_id, mode) for src_id in (1, 2, 3, 4, 1)))
    line.robots[0].start(boot=5 << 32 | 77)
    line.robots[4].start(boot=6 << 32 | 78)
    line.invariant.robots = []  # it knows robots by their numbers
    line.run(60)
    assert doubled(line.robots[2], line.now) == {1}
    assert not doubled(line.robots[1], line.now) - {1}


@pytest.mark.parametrize("mode", MODES[1:])
def test_a_robot_that_restarts_is_one_over_others_too(mode: SealMode) -> None:
    line = Line(*(robot(src_id, mode) for src_id in (1, 2, 3, 4)), loss=0.1)
    line.run(20)
    for _ in range(3):
        line.robots[0].start()
        line.run(15)
        assert not [found for one in line.robots for found in doubled(one, line.now)]
