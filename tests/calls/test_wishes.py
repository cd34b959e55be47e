"""Who wants which topics of whom, without a link."""

from __future__ import annotations

from itertools import pairwise
from math import inf

from gr_ros2.calls.wish_frames import GiveUp, WishAnswer, WishOutcome, WishRequest
from gr_ros2.calls.wishes import AGAIN_S, LEASE_S, MOST_WISHES, PATIENCE_S, HeldWishes, OwnWishes

SENT = WishAnswer(WishOutcome.SENT, 2.0)


def wish(name: str = "scan", rate: float = 2.0, for_s: int = 60) -> WishRequest:
    return WishRequest(name, rate, for_s)


def test_the_highest_rate_of_all_who_want_a_topic_counts() -> None:
    held = HeldWishes()
    for robot, rate in ((1, 2.0), (2, 5.0), (3, 1.0)):
        assert held.take(robot, 7, wish(rate=rate), 0.0)
    assert held.wanted(0.0) == {"scan": 5.0}
    held.give_up(2, "scan")
    assert held.wanted(0.0) == {"scan": 2.0}
    held.take(3, 7, wish(rate=0.0), 0.0)
    assert held.wanted(0.0) == {"scan": 0.0}


def test_a_wish_ends_by_itself_and_is_renewed() -> None:
    held = HeldWishes()
    held.take(1, 7, wish(for_s=10), 0.0)
    held.take(1, 7, wish("odom", for_s=3600), 0.0)
    assert held.next_end == 10.0
    held.take(1, 7, wish(for_s=10), 9.0)
    assert held.wanted(18.9).keys() == {"scan", "odom"}
    assert held.wanted(19.0).keys() == {"odom"}
    assert held.wanted(LEASE_S) == {}
    assert held.next_end == inf


def test_a_robot_that_starts_again_wants_nothing_of_before() -> None:
    held = HeldWishes()
    held.take(1, 7, wish(), 0.0)
    held.take(2, 7, wish("odom"), 0.0)
    held.started(1, 7)
    assert held.wanted(0.0).keys() == {"scan", "odom"}
    held.started(1, 8)
    assert held.wanted(0.0).keys() == {"odom"}


def test_each_robot_has_room_for_so_many_wishes() -> None:
    held = HeldWishes()
    assert all(held.take(1, 7, wish(f"topic_{number}"), 0.0) for number in range(MOST_WISHES))
    assert not held.take(1, 7, wish("one_more"), 0.0)
    assert held.take(1, 7, wish("topic_0"), 0.0)
    assert held.take(2, 7, wish("one_more"), 0.0)
    assert held.take(1, 7, wish("one_more"), LEASE_S)


def test_only_the_same_wish_is_a_renewal() -> None:
    held = HeldWishes()
    held.take(1, 7, wish(rate=2.0), 0.0)
    assert held.holds(1, 7, wish(rate=2.0), 1.0)
    assert held.holds(1, 7, wish(rate=1.0), 1.0)
    assert not held.holds(1, 7, wish(rate=3.0), 1.0)
    assert not held.holds(1, 7, wish(rate=0.0), 1.0)
    assert not held.holds(1, 8, wish(rate=2.0), 1.0)
    assert not held.holds(1, 7, wish(rate=2.0), LEASE_S)


def test_a_long_wish_is_asked_again_before_it_ends() -> None:
    own = OwnWishes()
    own.want(2, "scan", 2.0, 100.0, 0.0)
    assert own.due(0.0) == [(2, wish(for_s=60))]
    assert own.due(1.0) == []
    own.answered(2, wish(), SENT, 1.0)
    assert own.next_ask == 1.0 + LEASE_S / 2
    assert own.due(31.0) == [(2, wish(for_s=60))]
    own.answered(2, wish(), SENT, 32.0)
    assert own.due(62.0) == [(2, wish(for_s=38))]
    own.answered(2, wish(), SENT, 63.0)
    assert own.next_ask == inf
    assert own.due(99.0) == []
    assert own.due(100.0) == []
    assert [one.ended for _, _, one in own] == [100.0]
    own.expire(161.0)
    assert list(own) == []


def test_a_short_wish_is_asked_once() -> None:
    own = OwnWishes()
    own.want(2, "scan", 2.0, 60.0, 0.0)
    own.due(0.0)
    own.answered(2, wish(), SENT, 0.1)
    assert own.next_ask == inf


def test_a_wish_that_is_lost_is_asked_again() -> None:
    own = OwnWishes()
    own.want(2, "scan", 2.0, 300.0, 0.0)
    asked = [0.0]
    for _ in range(5):
        assert own.due(asked[-1]) == [(2, wish())]
        asked.append(own.next_ask)
    waits = [then - now for now, then in pairwise(asked)]
    assert waits == [AGAIN_S, 2 * AGAIN_S, 4 * AGAIN_S, PATIENCE_S, PATIENCE_S]
    own.met(2, 200.0)
    own.due(200.0)
    assert own.next_ask == 200.0 + AGAIN_S, "soon, of a robot that has started again"
    own.unheard(2, "scan", 240.0, 1.0)
    assert own.next_ask == 241.0


def test_a_robot_that_has_started_again_is_asked_again() -> None:
    own = OwnWishes()
    own.want(2, "scan", 2.0, 300.0, 0.0)
    own.want(3, "scan", 2.0, 300.0, 0.0)
    own.due(0.0)
    for robot in (2, 3):
        own.answered(robot, wish(), SENT, 0.0)
    own.met(2, 5.0)
    assert own.due(5.0) == [(2, wish())]


def test_a_wish_that_is_refused_is_over_and_remembered() -> None:
    own = OwnWishes()
    own.want(2, "scan", 2.0, 300.0, 0.0)
    own.due(0.0)
    own.answered(2, wish(), WishAnswer(WishOutcome.NOT_OFFERED), 1.0)
    own.met(2, 2.0)
    assert own.due(50.0) == []
    found = own.get(2, "scan")
    assert found is not None and found.answer is not None
    assert found.answer.outcome == WishOutcome.NOT_OFFERED


def test_what_is_given_up_is_told_once_and_answers_that_come_late_change_nothing() -> None:
    own = OwnWishes()
    own.want(2, "scan", 2.0, 300.0, 0.0)
    own.due(0.0)
    own.give_up(2, "scan", 1.0)
    assert own.next_ask == -inf
    assert own.due(1.0) == [(2, GiveUp("scan"))]
    own.answered(2, wish(), SENT, 2.0)
    assert own.next_ask == inf
    own.want(2, "scan", 3.0, 300.0, 3.0)
    own.due(3.0)
    own.answered(2, wish(), SENT, 4.0)  # of the wish before
    assert [one.answer for _, _, one in own] == [None]


def test_this_robot_has_room_for_so_many_wishes() -> None:
    own = OwnWishes()
    assert all(own.want(2, f"topic_{number}", 0.0, 100.0, 0.0) for number in range(MOST_WISHES))
    assert not own.want(3, "one_more", 0.0, 100.0, 0.0)
    assert own.want(2, "topic_0", 1.0, 100.0, 0.0)
    for number in range(1000):
        own.give_up(2, f"topic_{number}", 0.0)
        own.want(2, f"topic_{number}", 0.0, 100.0, 0.0)
    assert len(list(own)) <= 2 * MOST_WISHES + 1
