"""Slots from what is heard: rate, entry, who yields, maps, names, late hosts, and packets that are not checked."""

from __future__ import annotations

import random
from collections.abc import Callable
from functools import partial

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fuzz.loop import work
from gr_ros2.core.errors import EntryBoundsError
from gr_ros2.core.tuning import Tuning
from gr_ros2.mac.slots import Slots
from gr_ros2.wire.mac_block import NOBODY, Block, read_block

TUNING = Tuning()

SLOT = 0.0145


def robot(src_id: int = 5, seed: int = 1, **kwargs: float) -> Slots:
    made = Slots(src_id, SLOT, random.Random(seed), **{"period_s": 0.1, **kwargs})
    made.clock.start(0.0)
    return made


def send(of: Slots, now: float, weight: int = 1) -> tuple[float, Block]:
    """Its next packet: begin and block."""
    for _ in range(10):
        now = of.departure(now)
        data = of.block(weight)
        if data is not None:
            return now, read_block(data)[0]
    raise AssertionError("it never sends")


def hear(of: Slots, src_id: int, slot: int, block: Block, *, trusted: bool = True, checked: bool = False) -> None:
    of.hear(src_id, block._replace(slot=slot % 256), of.clock.begin(slot), trusted=trusted, checked=checked)


def test_a_robot_keeps_what_it_announces() -> None:
    made = robot()
    hear(made, 1, 60, Block(0, (200, 200), 1, (5, NOBODY)))
    begin, block = send(made, 1.0)
    for _ in range(50):
        slot = made.clock.slot(begin + SLOT / 2)
        hear(made, 1, slot + 1, Block(0, (200, 200), 1, (5, NOBODY)))
        begin, after = send(made, begin + SLOT / 2)
        assert made.clock.slot(begin + SLOT / 2) == slot + block.ahead[0]
        assert made.reserved
        block = after


def test_the_interval_leaves_room_for_the_most_robots_that_anybody_hears() -> None:
    made = robot()
    _, block = send(made, 1.0)
    for other in range(19):
        hear(made, other if other < 5 else other + 1, 70 + other, Block(0, (30, 30), 19, (5, NOBODY)))
    begin, _ = send(made, 1.5)
    for _ in range(8):
        slot = made.clock.slot(begin + SLOT / 2)
        for other in range(4):
            hear(made, other, slot + other + 1, Block(0, (300, 300), 19, (5, NOBODY)))
        begin, block = send(made, begin + SLOT / 2)
    assert 21 <= block.ahead[1] <= 30


def test_no_slot_is_taken_that_a_neighbour_has_announced_or_expects_to_receive_in() -> None:
    made = robot()
    for at in range(400):
        block = Block(0, (7, 7), 1, (5, NOBODY), expected=0x0F0F0F0F)
        if at % 7 == 0:
            hear(made, 1, at, block)
    free = [slot for slot in range(394, 425) if made.calendar.free(slot)]
    assert 399 + 7 not in free
    assert not any(393 <= slot < 425 and 0x0F0F0F0F >> (slot - 400) & 1 for slot in free if slot >= 400)


def cell(count: int, slots: int, fills: Callable[[int, int], bool]) -> list[tuple[int, int]]:
    """Slot and robot of each packet that nothing collides with, in a cell whose robots all hear each other.

    :param fills: whether a robot has video in a slot
    """
    robots = [robot(src_id, seed=src_id, period_s=0.0) for src_id in range(count)]
    sent, now = [], SLOT / 2
    for slot in range(1, slots):
        now = slot * SLOT
        packets = []
        for one in robots:
            if one.departure(now) < now + SLOT / 2 and (data := one.block(fills=fills(one.src_id, slot))) is not None:
                packets.append((one.src_id, read_block(data)[0]))
        if len(packets) == 1:
            ((src_id, block),) = packets
            sent.append((slot, src_id))
            for other in robots:
                other.hear(src_id, block, slot * SLOT)
    return sent


def share(sent: list[tuple[int, int]], src_id: int, begin: int, end: int) -> float:
    """Packets of a robot in each hundred slots."""
    return sum(begin <= slot < end and who == src_id for slot, who in sent) / (end - begin) * 100


@pytest.mark.parametrize("count", [2, 4, 10])
def test_video_gets_more_slots_and_no_other_turn_comes_one_and_a_half_times_as_late(count: int) -> None:
    sent = cell(count, 4000, lambda src_id, slot: src_id == 0 and 2000 <= slot < 3000)
    for src_id in range(1, count):
        even, beside, after = (share(sent, src_id, *span) for span in ((1000, 2000), (2300, 3000), (3300, 4000)))
        assert even / 1.55 < beside
        assert after > 0.95 * even
    even, filled, after = (share(sent, 0, *span) for span in ((1000, 2000), (2300, 3000), (3300, 4000)))
    extra = int(TUNING.slots_filled * (count + 1))
    assert filled > 0.95 * 100 * (1 + extra) / (count + 1 + extra) > 1.3 * even
    assert after < 1.1 * even


def test_video_does_not_vie_with_who_relays_much() -> None:
    made = robot(period_s=0.0)
    begin, _ = send(made, 1.0)
    weights = []
    for _ in range(60):
        hear(made, 1, made.clock.slot(begin + SLOT / 2) + 1, Block(0, (3, 3), 17, (5, NOBODY), 0, weight=16))
        begin = made.departure(begin + SLOT / 2)
        if (data := made.block(fills=True)) is not None:
            weights.append(read_block(data)[0].weight)
    assert 1 < max(weights) <= 1 + int(TUNING.slots_filled * 3)


@pytest.mark.parametrize("cameras", [2, 3, 10])
def test_several_robots_with_video_share_what_it_may_take(cameras: int) -> None:
    sent = cell(10, 6000, lambda src_id, slot: src_id < cameras and slot >= 1000)
    shares = [share(sent, src_id, 3000, 6000) for src_id in range(10)]
    assert min(shares) > 100 / 11 / 1.6
    if cameras < 10:
        assert min(shares[:cameras]) > 1.2 * max(shares[cameras:])
    assert max(shares) < 2.2 * min(shares[:cameras])


def test_a_robot_with_weight_sends_as_often_and_says_so() -> None:
    made = robot()
    later = TUNING.slots_newcomer + 1
    for other in range(16):
        hear(made, 10 + other, 70 + other, Block(0, (300, 300), 8, (5, NOBODY)))
        hear(made, 10 + other, 70 + other + later, Block(0, (300, 300), 8, (5, NOBODY)))
    begin, block = send(made, 1.5 + later * SLOT, weight=4)
    assert (block.weight, block.heard) == (4, 16)
    assert (16 + 4 + 1) // 4 <= block.ahead[1] < (16 + 4 + 1) // 4 + TUNING.slots_choice
    hear(made, 10, made.clock.slot(begin + SLOT / 2) + 1, Block(0, (300, 300), 8, (5, NOBODY), 0, weight=3))
    _, block = send(made, begin + SLOT)
    assert (block.weight, block.heard) == (1, 18)


def test_frames_have_a_slot_for_each_newcomer_until_it_is_none_any_more() -> None:
    made = robot()
    for other in range(16):
        hear(made, 10 + other, 70 + other, Block(0, (300, 300), 16, (5, NOBODY)))
    assert made._frame(90, made.around.loads(90, 1)) == 17 + 1 + 16
    late = 70 + TUNING.slots_newcomer
    assert made._frame(late + 8, made.around.loads(late + 8, 1)) == 17 + 1 + 8
    assert made._frame(late + 16, made.around.loads(late + 16, 1)) == 17 + 1


def test_a_robot_that_hears_other_slots_counts_who_has_them_and_picks_at_random_until_it_forgets_them() -> None:
    made = robot()
    hear(made, 7, 60, Block(0, (300, 300), 1, (5, NOBODY)))
    hear(made, 8, 61, Block(0, (300, 300), 1, (5, NOBODY)))
    before = max(made.around.loads(70, 1))
    made.hear(9, Block(62, (300, 300), 1, (5, NOBODY)), 62.5 * SLOT)
    assert max(made.around.loads(70, 1)) == before + 1
    made._confirmed_at = 70
    assert len({made._pick(77, 70, 20) for _ in range(100)}) == TUNING.slots_choice
    made._confirmed_at = late = 70 + 2 * TUNING.slots_heard
    made._sweep(late)
    hear(made, 7, late, Block(0, (300, 300), 1, (5, NOBODY)))
    assert made.around.loads(late, 1)[0] == 2
    assert len({made._pick(late + 7, late, 20) for _ in range(100)}) < TUNING.slots_choice


def test_a_slot_in_whose_place_somebody_sends_one_frame_before_is_passed_over() -> None:
    made = robot()
    hear(made, 7, 60, Block(0, (300, 300), 1, (5, NOBODY)))
    made._confirmed_at, frame = 70, made._frame(70, made.around.loads(70, 1))
    made.calendar._taken |= {77 + frame: 7, 78: 7}
    assert made._pick(77, 70, frame) == 77 + frame + 2


def test_who_is_not_in_three_maps_in_a_row_of_a_neighbour_picks_at_random() -> None:
    made = robot()
    begin, block = send(made, 1.0)
    slot = made.clock.slot(begin + SLOT / 2)
    for later, expected, deaf in ((2, 1 << block.ahead[0] - 3, False), (3, 0, False), (4, 0, False), (5, 0, True)):
        hear(made, 9, slot + later, Block(0, (300, 9), 1, (5, NOBODY), expected))
        assert made.around.deaf(slot + later) is deaf


def test_the_lower_id_keeps_a_slot_that_two_want() -> None:
    for other, keeps in ((9, True), (2, False)):
        made = robot(5)
        hear(made, 8, 60, Block(0, (300, 300), 1, (5, NOBODY)))
        begin, block = send(made, 1.0)
        slot = made.clock.slot(begin + SLOT / 2)
        wanted = slot + block.ahead[0]
        hear(made, other, slot + 1, Block(0, (wanted - slot - 1, 9), 1, (5, NOBODY)))
        at, _ = send(made, begin + SLOT / 2)
        assert (made.clock.slot(at + SLOT / 2) == wanted) is keeps


def test_a_conflict_that_a_neighbour_names_is_given_up() -> None:
    made = robot(5)
    begin, block = send(made, 1.0)
    slot = made.clock.slot(begin + SLOT / 2)
    ahead = block.ahead[0]
    hear(made, 9, slot + 1, Block(0, (99, 9), 1, (5, NOBODY), 0, (ahead - 1, 5)))
    assert slot + ahead not in made._mine


def test_two_that_others_want_are_named_with_who_yields() -> None:
    made = robot(5)
    hear(made, 1, 60, Block(0, (40, 20), 3, (5, NOBODY)))
    hear(made, 2, 61, Block(0, (39, 20), 2, (5, NOBODY)))
    begin, block = send(made, 62 * SLOT)
    assert block.conflict == (100 - made.clock.slot(begin + SLOT / 2), 2)


def test_the_map_says_where_it_expects_to_receive_and_only_where_somebody_may_be_hidden() -> None:
    made = robot(5)
    hear(made, 1, 60, Block(0, (20, 20), 1, (5, NOBODY)))
    begin, block = send(made, 61 * SLOT)
    assert block.expected is None, "both hear one robot"
    hear(made, 1, 80, Block(0, (20, 20), 2, (5, 7)))
    hear(made, 1, 300, Block(0, (20, 20), 2, (5, 7)))
    begin, block = send(made, max(begin + SLOT, 301 * SLOT))
    slot = made.clock.slot(begin + SLOT / 2)
    assert block.expected is not None
    assert {slot + 1 + n for n in range(32) if block.expected >> n & 1} == {
        at for at in (320, 340) if 0 < at - slot < 33
    }


def test_newcomers_are_named_first() -> None:
    made = robot(5)
    for n in range(6):
        hear(made, 10 + n, 60 + n, Block(0, (40, 40), 6, (10 + n // 2 * 2, 11 + n // 2 * 2)))
    begin, _ = send(made, 67 * SLOT)
    hear(made, 3, made.clock.slot(begin) + 2, Block(0, (40, 40), 6, (5, NOBODY)))
    _, block = send(made, begin + SLOT)
    assert 3 in block.names


def test_an_entrant_claims_no_slot_that_it_has_not_announced() -> None:
    made = robot(5)
    hear(made, 9, 60, Block(0, (40, 40), 1, (5, NOBODY)))
    made.departure(made.clock.begin(61))
    entry = made._mine[0]
    hear(made, 9, 62, Block(0, (entry - 62, 40), 1, (5, NOBODY)))
    assert made._mine == [], "whoever has the lower id"
    assert not made.calendar._conflicts


def test_an_entrant_waits_for_who_is_to_name_it_however_seldom_that_one_sends() -> None:
    made = robot(5)
    hear(made, 1, 60, Block(0, (50, 90), 1, (NOBODY, NOBODY)))
    begin, _ = send(made, 61 * SLOT)
    while made.clock.slot(begin) < 100:
        begin, _ = send(made, begin + SLOT / 2)
        assert made.reserved, "it stays"


def test_a_robot_that_was_alone_for_long_sends_soon_once_it_hears_somebody() -> None:
    made = robot(5)
    begin = 1.0
    for _ in range(8):
        begin, block = send(made, begin + SLOT / 2)
    slot = made.clock.slot(begin + SLOT / 2)
    assert block.ahead[0] > 30
    hear(made, 9, slot + 2, Block(0, (200, 200), 1, (NOBODY, NOBODY)))
    begin, block = send(made, begin + 3 * SLOT)
    assert made.clock.slot(begin + SLOT / 2) < slot + 20
    assert block.names[0] == 9
    assert block.ahead[0] < 10


@pytest.mark.parametrize("heard", [0, 1])
def test_who_hears_nobody_in_its_own_slots_moves_to_those_of_a_robot_that_hears_others(heard: int) -> None:
    made = robot(5)
    begin, _ = send(made, 1.0)
    slot = made.clock.slot(begin + SLOT / 2)
    behind = Block((slot + 1) % 256, (20, 20), heard, (NOBODY, NOBODY))
    made.hear(9, behind, made.clock.begin(slot + 1) + SLOT / 2)
    assert made.clock.jumps == heard
    assert (set(made.around.robots) == {9}) == bool(heard)


def test_an_entrant_that_nobody_names_starts_over() -> None:
    made = robot(5)
    hear(made, 1, 60, Block(0, (200, 200), 2, (NOBODY, NOBODY)))
    begin, block = send(made, 61 * SLOT)
    hear(made, 1, made.clock.slot(begin + SLOT / 2) + 1, Block(0, (200, 200), 2, (7, 8)))
    assert made.departure(begin + SLOT) == pytest.approx(begin + block.ahead[0] * SLOT)
    assert made.block() is None
    send(made, begin + block.ahead[0] * SLOT)
    assert not made.reserved


@pytest.mark.parametrize("names", [True, False])
def test_a_robot_that_none_of_those_it_hears_names_knows_it(names: bool) -> None:
    made = robot()
    begin, _ = send(made, 0.0)
    assert not made.unheard(begin)
    for slot in range(40, 1000, 5):
        hear(made, 1, slot, Block(0, (5, 5), 1, (5 if names else 7, NOBODY)))
    assert made.unheard(made.clock.begin(1001)) is not names
    assert not made.unheard(made.clock.begin(5000)), "nobody is heard any more"


@pytest.mark.parametrize("moves", [False, True])
def test_who_is_heard_for_a_moment_only_need_not_have_named_this_robot(moves: bool) -> None:
    """It came late, or its clock has moved this one's."""
    made = robot()
    send(made, 0.0)
    if moves:
        for slot in range(40, 1000, 5):
            hear(made, 1, slot, Block(0, (5, 5), 1, (5, NOBODY)))
        made._start_over(1000, 14.5)
    for slot in range(1001, 1800, 5):
        hear(made, 2, slot, Block(0, (5, 5), 1, (NOBODY, NOBODY)))
        assert not made.unheard(made.clock.begin(slot + 1)) or slot > 1000 + 3 * TUNING.slots_heard
    assert made.unheard(made.clock.begin(1800))


def test_a_robot_that_asks_ahead_of_the_end_of_its_silence_gets_a_slot_after_it() -> None:
    made = Slots(5, SLOT, random.Random(1), period_s=0.1)
    at = made.departure(3.0)
    assert at == pytest.approx(3.0 + TUNING.slots_quiet * SLOT)
    assert made.block() is None
    assert made.departure(at - 0.005) > at


def test_a_host_that_was_late_sends_in_a_later_slot() -> None:
    made = robot(5)
    begin, _ = send(made, 1.0)
    at, _ = send(made, begin + 1.0)
    assert at >= begin + 1.0 - SLOT / 2


def test_a_slot_that_somebody_has_announced_is_not_entered_however_long_ago_this_robot_has_sent() -> None:
    made = robot(5)
    hear(made, 1, 60, Block(0, (200, 200), 1, (NOBODY, NOBODY)))
    made._mine, made._since = [260], 0.0
    made._rate = 1.0
    assert made.departure(made.clock.begin(259)) == made.clock.begin(260)
    assert made.block() is None


def test_once_a_trusted_robot_is_heard_what_was_not_checked_says_nothing() -> None:
    made = robot(5)
    hear(made, 1, 60, Block(0, (40, 40), 1, (5, NOBODY)))
    before = dict(made.calendar._taken), dict(made.around.robots), made.calendar._expected, made.clock.begin(0)
    for at in range(61, 90):
        hear(made, 100 + at, at, Block(0, (10, 10), 60, (5, 9), 0xFFFFFF, (4, 5)), trusted=False)
        made.hear(100, Block(7, (3, 3)), at * SLOT + 0.4 * SLOT, trusted=False)
    assert (
        dict(made.calendar._taken),
        dict(made.around.robots),
        made.calendar._expected,
        made.clock.begin(0),
    ) == before
    assert made.clock.jumps == 0


def test_what_may_be_a_recording_keeps_its_slots_free_and_its_sender_is_named() -> None:
    made = robot(5)
    hear(made, 1, 60, Block(0, (300, 300), 1, (5, NOBODY)))
    begin, block = send(made, 61 * SLOT)
    slot = made.clock.slot(begin + SLOT / 2)
    claim = Block(0, (block.ahead[0] - 1, 40), 60, (5, 9), 0xFFFFFFF, (block.ahead[0] - 1, 5), weight=8)
    hear(made, 2, slot + 1, claim, trusted=False, checked=True)
    assert not made.calendar.free(slot + block.ahead[0] + 40)
    assert not made.calendar._expected
    at, after = send(made, begin + SLOT / 2)
    assert made.clock.slot(at + SLOT / 2) == slot + block.ahead[0], "it stays"
    assert 2 in after.names
    assert after.heard == 2, "it is one robot, whatever it says"
    made.hear(2, Block(99, (3, 3)), at + 5.4 * SLOT, trusted=False, checked=True)
    assert made.clock.jumps == 0


def test_packets_that_are_not_checked_keep_their_slots_free_and_do_nothing_else() -> None:
    made = robot(5)
    begin, block = send(made, 1.0)
    slot = made.clock.slot(begin + SLOT / 2)
    claim = Block(0, (block.ahead[0] - 1, 5), 60, (9, 9), (1 << 32) - 1, (block.ahead[0] - 1, 5))
    hear(made, 1, slot + 1, claim, trusted=False)
    at, after = send(made, begin + SLOT / 2)
    assert made.clock.slot(at + SLOT / 2) == slot + block.ahead[0], "it stays"
    assert after.heard == 0
    hear(made, 1, slot + 20, Block(0, (13, 0)), trusted=False)
    assert not made.calendar.free(slot + 33)


def test_robots_that_left_are_forgotten() -> None:
    made = robot(5)
    for n in range(10):
        hear(made, 10 + n, 60 + n, Block(0, (40, 40), 10, (5, NOBODY)))
    begin, _ = send(made, 71 * SLOT)
    for _ in range(60):
        begin, block = send(made, begin + SLOT)
    assert begin > TUNING.slots_heard * SLOT + 2
    assert block.heard == 0


@settings(max_examples=40)
@given(
    st.lists(
        st.tuples(st.integers(0, 254), st.floats(0, 20), st.binary(min_size=12, max_size=12), st.integers(0, 2)),
        max_size=60,
    )
)
def test_whatever_is_heard_it_sends_in_slots_and_the_work_is_bounded(
    heard: list[tuple[int, float, bytes, int]],
) -> None:
    made = robot(5)
    now = 1.0
    for src_id, at, data, trusted in heard:
        try:
            block = read_block(data)[0]
        except EntryBoundsError:
            continue
        lines, _ = work(partial(made.hear, src_id, block, at, trusted=trusted > 1, checked=trusted > 0))
        assert lines < 600
        now = made.departure(now)
        sent = made.block()
        if sent is not None:
            assert read_block(sent)[0].ahead[0] > 0
            now += SLOT / 2
