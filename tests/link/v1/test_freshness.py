"""Whose turn it is."""

from __future__ import annotations

from gr_ros2.link.v1.freshness import TURN, Turns


def test_turns_go_round_and_the_first_ones_in_the_order_of_the_first_messages() -> None:
    turns = Turns()
    for topic_id in (4, 0, 1, 4):
        turns.join(topic_id)
    had = []
    for _ in range(5 * TURN):
        holder = turns.holder({0, 1, 4, 240})
        turns.sent([holder])
        had.append(holder)
    assert had[TURN - 1 :: TURN] == [4, 0, 1, 4, 0]
    assert set(had) == {-1, 0, 1, 4}, "240 has not joined: it has no turn"
    for _ in range(TURN):
        assert turns.holder({240}) == -1
        turns.sent([-1])
