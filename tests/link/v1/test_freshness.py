"""Whose turn it is."""

from __future__ import annotations

from gr_ros2.core.tuning import Tuning
from gr_ros2.link.v1.freshness import Turns

TUNING = Tuning()


def test_turns_go_round_and_the_first_ones_in_the_order_of_the_first_messages() -> None:
    turns = Turns(TUNING)
    for topic_id in (4, 0, 1, 4):
        turns.join(topic_id)
    had = []
    for _ in range(5 * TUNING.turn_every):
        holder = turns.holder({0, 1, 4, 240})
        turns.sent([holder])
        had.append(holder)
    assert had[TUNING.turn_every - 1 :: TUNING.turn_every] == [4, 0, 1, 4, 0]
    assert set(had) == {-1, 0, 1, 4}, "240 has not joined: it has no turn"
    for _ in range(TUNING.turn_every):
        assert turns.holder({240}) == -1
        turns.sent([-1])
