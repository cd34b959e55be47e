"""The robots that one hears in its slots."""

from __future__ import annotations

from gr_ros2.core.tuning import Tuning
from gr_ros2.mac.around import Around, SlotOwner

TUNING = Tuning()


def with_robots(*slots: int) -> Around:
    around = Around(TUNING)
    for robot, slot in enumerate(slots):
        around.heard(slot)
        around.robots[robot] = SlotOwner(slot)
    return around


def test_a_robot_counts_as_heard_for_a_number_of_slots() -> None:
    around = with_robots(0, 100)
    assert len(around.present(TUNING.slots_heard)) == 2
    assert len(around.present(TUNING.slots_heard + 1)) == 1
    assert not around.nobody(100 + TUNING.slots_lately)
    assert around.nobody(101 + TUNING.slots_lately)
    around.forget(2 * TUNING.slots_heard + 1, elsewhere_before=0.0)
    assert list(around.robots) == [1]


def test_loads_are_those_of_this_robot_and_of_all_that_it_hears() -> None:
    around = with_robots(0, 0)
    around.robots[1].weight, around.robots[1].heard = 3, 5
    around.elsewhere = {1: 0.0, 9: 0.0}  # robot 1 counts once
    assert around.loads(0, weight=2) == [2 + 1 + 1 + 3, 1, 8]


def test_those_are_named_first_that_were_named_the_longest_time_ago() -> None:
    around = with_robots(0, 0, 0, 0)
    for robot, named in enumerate((7, 3, 9, 5)):
        around.robots[robot].named = named
    assert [name for name, _ in around.unnamed(0)] == [1, 3]


def test_a_neighbour_that_does_not_expect_this_robot_is_found() -> None:
    around = with_robots(0)
    assert not around.deaf(0)
    around.robots[0].deaf = TUNING.slots_deaf
    assert around.deaf(TUNING.slots_lately)
    assert not around.deaf(TUNING.slots_lately + 1)


def test_when_slots_are_counted_otherwise_all_are_elsewhere() -> None:
    around = with_robots(0, 0)
    around.part(3.0)
    assert around.elsewhere == {0: 3.0, 1: 3.0}
    assert not around.robots
    assert around.nobody(0)
