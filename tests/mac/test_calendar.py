"""Which slots others want."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from gr_ros2.mac.calendar import Calendar
from gr_ros2.wire.mac_block import NOBODY

SLOT = st.integers(1, 60)
ROBOT = st.integers(1, 5)


def test_a_slot_that_two_robots_want_stays_with_the_lower_id_and_is_said_once() -> None:
    calendar = Calendar()
    assert calendar.announce(9, 4)
    assert not calendar.announce(9, 2)
    calendar.claim(9, 2)
    assert calendar.announce(9, 2)
    assert calendar.conflict(5) == (4, 4)
    assert calendar.conflict(5) == (0, NOBODY)


@given(st.dictionaries(SLOT, ROBOT), st.sets(SLOT), SLOT)
def test_what_has_passed_is_forgotten_and_nothing_else(taken: dict[int, int], heard: set[int], now: int) -> None:
    calendar = Calendar()
    for slot, robot in taken.items():
        calendar.announce(slot, robot)
    calendar.expect(0, sum(1 << slot for slot in heard), mine=())
    before = {slot: calendar.free(slot) for slot in range(now + 1, 62)}
    calendar.forget(now)
    assert {slot: calendar.free(slot) for slot in before} == before
    assert all(calendar.free(slot) for slot in range(now + 1))


@given(st.dictionaries(SLOT, ROBOT), ROBOT)
def test_who_withdraws_its_slots_keeps_those_of_others(taken: dict[int, int], gone: int) -> None:
    calendar = Calendar()
    for slot, robot in taken.items():
        calendar.announce(slot, robot)
    calendar.withdraw(gone, taken)
    assert {slot for slot in range(1, 61) if not calendar.free(slot)} == {
        slot for slot, robot in taken.items() if robot != gone
    }


def test_a_neighbour_that_expects_this_robot_leaves_its_slot_free() -> None:
    calendar = Calendar()
    calendar.expect(1, 0b101, mine=[3])
    assert not calendar.free(1)
    assert calendar.free(2)
    assert calendar.free(3)
