"""The clock of the slots: it follows, it moves to another group's slots, and it stays where it should."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gr_ros2.core.tuning import Tuning
from gr_ros2.mac.slot_clock import SlotClock

TUNING = Tuning()

SLOT = 0.015


def clock(now: float = 100.0) -> SlotClock:
    made = SlotClock(SLOT, TUNING)
    made.start(now)
    made.said()
    return made


def hear(
    of: SlotClock, src_id: int, slot: int, shift: float = 0.0, *, trusted: bool = True, checked: bool = True
) -> int | None:
    """A packet in this slot of the clock, which begins ``shift`` s late."""
    return of.heard(src_id, slot % 256, of.begin(slot) + shift, trusted=trusted, checked=checked)


def test_the_first_packet_heard_decides_where_the_slots_are() -> None:
    made = SlotClock(SLOT, TUNING)
    assert not made.runs
    assert made.heard(1, 200, 50.0, trusted=True) == 200
    assert made.begin(200) == pytest.approx(50.0)
    assert made.slot(50.0 + 2.5 * SLOT) == 202


@given(st.floats(-0.2, 0.2), st.integers(0, 100_000))
def test_it_follows_a_clock_that_is_a_little_off(shift: float, slot: int) -> None:
    made = clock()
    for n in range(40):
        assert hear(made, 1, slot + n, shift * SLOT if not n else 0.0) == slot + n
    assert made.jumps == 0
    assert abs(made.begin(slot) - clock().begin(slot)) <= abs(shift) * SLOT + 1e-9


@given(st.floats(1.0, 120.0))
def test_one_of_two_that_meet_moves(ahead: float) -> None:
    """To the slots of who is ahead by less than half of the numbers."""
    ones, others = clock(), clock(100.0 - ahead * SLOT)
    began = 130.0
    sent = [(of.slot(began) % 256, of.begin(of.slot(began))) for of in (ones, others)]
    seen_by_ones = ones.heard(2, *sent[1], trusted=True)
    seen_by_others = others.heard(1, *sent[0], trusted=True)
    assert (seen_by_ones is None, seen_by_others is None) == (False, True)
    assert (ones.jumps, others.jumps) == (1, 0)


def test_a_robot_whose_clock_has_jumped_is_given_time_to_notice() -> None:
    made = clock()
    for n in range(10):
        hear(made, 1 + n % 2, n)
    slots = TUNING.clock_patience
    for n in range(10, 10 + slots - 1, 2):
        assert hear(made, 1, n, -1.0) is None
        assert hear(made, 2, n + 1) == n + 1
    assert made.jumps == 0
    assert hear(made, 1, 12 + slots, -1.0) is not None, "it may be another group that it has joined"


def test_a_clock_that_has_jumped_itself_goes_back_to_the_others() -> None:
    made = clock()
    for n in range(10):
        hear(made, 1 + n % 3, n)
    assert hear(made, 1, 10, 1.0) is None
    assert hear(made, 2, 11, 1.0) is not None
    assert made.jumps == 1
    assert hear(made, 3, 12) == 12


def test_packets_that_are_not_trusted_move_nobody_who_hears_others() -> None:
    made = clock()
    hear(made, 1, 0)
    before = made.begin(0)
    assert hear(made, 2, 1, -1.0, trusted=False) is None
    assert hear(made, 2, 2, 0.1 * SLOT, trusted=False) == 2
    assert made.begin(0) == before
    late = 60 + TUNING.clock_memory
    assert hear(made, 2, late, -0.7, trusted=False) is not None


def test_what_was_not_checked_starts_a_clock_and_moves_none() -> None:
    made = SlotClock(SLOT, TUNING)
    assert made.heard(2, 7, 50.0, trusted=False) == 7
    assert made.heard(3, 9, 50.0 + 4.3 * SLOT, trusted=False) is None
    assert made.heard(3, 7, 50.0 + 0.1 * SLOT, trusted=False) == 7
    assert made.begin(7) == 50.0
    assert made.heard(4, 99, 50.0 + 7.6 * SLOT, trusted=False, checked=True) is not None, "it knows better"
    assert made.begin(99) % SLOT == pytest.approx((50.0 + 7.6 * SLOT) % SLOT)
    assert hear(made, 5, 110, 0.4, trusted=False) is None, "once only"


def test_where_nobody_agrees_who_is_behind_is_followed_sooner() -> None:
    for agreed in (True, False):
        made = clock()
        if agreed:
            hear(made, 1, 0)
        assert hear(made, 2, 1, 0.4 * SLOT) is None
        hear(made, 2, TUNING.clock_patience + 2, 0.4 * SLOT)
        assert made.jumps == (0 if agreed else 1)


def test_a_group_that_stays_behind_is_told_in_its_own_slots() -> None:
    made = clock()
    slots, stays = TUNING.clock_behind, TUNING.clock_stays
    for n in range(0, 2 * slots, 2):
        hear(made, 1, n)
        if hear(made, 2, n + 1, 0.4) is not None:
            break
    assert n == pytest.approx(slots, abs=2)
    assert made.jumps == 1
    assert hear(made, 1, n + stays - 9, -0.4) is None, "it would leave before it is heard"
    assert hear(made, 1, n + TUNING.clock_memory + 40, -0.4) is not None


def test_a_clock_that_nobody_can_follow_yet_moves_to_whoever_is_heard() -> None:
    for error in (-0.5, 0.5):
        made = SlotClock(1.0, TUNING)
        made.start(100.0)
        assert made.heard(2, 0, 110.0 + error, trusted=True) is not None
        assert made.jumps == 1


def test_two_that_began_a_part_of_a_slot_apart_agree_after_a_packet_of_each() -> None:
    one, two = clock(100.0), clock(100.0 + 0.2 * SLOT)
    assert two.heard(1, 3, one.begin(3), trusted=True) == 3
    assert one.heard(2, 5, 100.0 + 5.2 * SLOT, trusted=True) == 5  # it had left before
    assert one.begin(7) == pytest.approx(two.begin(7), abs=1e-6)
