"""Which messages of reliable topics are sent on, in which order, how often, and to whom."""

from __future__ import annotations

from math import inf

from gr_ros2.core.tuning import Tuning
from gr_ros2.relay.gain import EXPIRES_S, Gains, Stream
from gr_ros2.relay.in_order import COST, InOrder, Kept, Name
from gr_ros2.relay.memory import Memory
from gr_ros2.relay.quotas import Quotas
from gr_ros2.relay.robots import OtherRobots
from gr_ros2.wire.control import Newest
from gr_ros2.wire.relayed import Relayed
from gr_ros2.wire.v1 import TABLE_TOPIC

TUNING = Tuning()

GOAL = Stream(1, 7, 3)


def at_robot_2(*, most: int = 100) -> tuple[Gains, InOrder]:
    """Robot 2 hears 1, and 3 and 4, which do not hear 1."""
    gains = Gains(2, OtherRobots())
    gains.neighbour(1, 0.0, [2], 1)
    gains.neighbour(3, 0.0, [2, 4], 2)
    gains.neighbour(4, 0.0, [2, 3], 2)
    return gains, InOrder(gains, Quotas(most, Memory(1 << 20).share(), COST))


def keep(kept: InOrder, *numbers: int, until: float = inf, late: int = 0) -> None:
    for number in numbers:
        message = Relayed(1, 7, number, 0, 3, 0, b"goal", after=(number - 1, 0))
        kept.keep(Kept(message, 0.0, until), 1, late)


def told(number: int, place: int = 255) -> Newest:
    return Newest(1, 7, 3, number, place)


def chosen(kept: InOrder, now: float) -> int | None:
    name = kept.best(now)[0]
    return None if name is None else name.order[0]


def test_the_oldest_that_a_robot_lacks_is_sent_first_and_each_once() -> None:
    _, kept = at_robot_2()
    keep(kept, 1, 2, 3)
    assert chosen(kept, 0.0) is None, "nobody has told what he has"
    kept.told(3, told(0), 0.0)
    sent = []
    while (name := kept.best(0.1)[0]) is not None:
        sent.append(name.order[0])
        kept.sent(name, 0.1)
    assert sent == [1, 2, 3]


def test_what_a_robot_still_lacks_is_sent_again_once_it_has_told_so() -> None:
    _, kept = at_robot_2()
    keep(kept, 1)
    kept.told(3, told(0), 0.0)
    kept.sent(Name(GOAL, (1, 0)), 0.1)
    assert chosen(kept, 2.0) is None, "it has told nothing since"
    kept.told(3, told(0), 1.0)
    assert chosen(kept, 0.1 + TUNING.relay_again_s / 2) is None
    assert chosen(kept, 2.0) == 1
    kept.told(3, told(1), 1.0)
    assert chosen(kept, 2.0) is None


def test_what_another_robot_has_sent_on_counts_as_sent() -> None:
    _, kept = at_robot_2()
    keep(kept, 1)
    kept.told(3, told(0), 0.0)
    kept.heard(4, Name(GOAL, (1, 0)), 0.1)
    assert chosen(kept, 0.2) is None


def test_who_was_told_a_number_too_high_gets_what_comes_once_it_has_expired() -> None:
    gains, kept = at_robot_2()
    keep(kept, 1, 2)
    for second in range(int(EXPIRES_S) + 3):
        gains.neighbour(3, second, [2, 4], 2)
        kept.told(3, told(30_000), second)
        assert chosen(kept, second + 0.5) is None
    keep(kept, 3)
    assert chosen(kept, second + 0.5) == 3
    kept.told(3, told(30_000), second + 0.6)
    assert chosen(kept, second + 0.7) == 3, "it tells so again and again, more often than messages leave"


def test_who_has_more_than_is_here_gets_none_of_it_when_it_comes() -> None:
    gains, kept = at_robot_2()
    keep(kept, 1)
    for second in range(2 * int(EXPIRES_S)):
        gains.neighbour(3, second, [2, 4], 2)
        kept.told(3, told(second + 10), second)
        if second % 10 == 9:
            keep(kept, second)
        assert chosen(kept, second + 0.5) is None
    kept.told(3, told(second - 1), second)
    assert chosen(kept, second + 0.5) == second


def test_who_hears_the_origin_needs_nothing() -> None:
    gains, kept = at_robot_2()
    keep(kept, 1)
    kept.told(3, told(0), 0.0)
    gains.neighbour(3, 0.1, [1, 2, 4], 3)
    assert chosen(kept, 0.2) is None


def test_of_a_kept_topic_late_robots_get_the_newest() -> None:
    gains, kept = at_robot_2()
    keep(kept, 1, 2, 3, 4, late=2)
    table = GOAL._replace(topic_id=TABLE_TOPIC)
    gains.message(1, table, 1, 0.0)
    assert chosen(kept, 0.0) is None, "nobody knows the table"
    gains.told(3, Newest(1, 7, TABLE_TOPIC, 1))
    assert chosen(kept, 0.0) == 3
    kept.sent(Name(GOAL, (3, 0)), 0.0)
    assert chosen(kept, 0.1) is None, "4 might come first"
    kept.told(3, told(3, 0), 0.2)
    assert chosen(kept, 0.2) == 4


def test_what_is_of_no_more_use_is_skipped() -> None:
    _, kept = at_robot_2()
    keep(kept, 1, until=1.0)
    keep(kept, 2)
    kept.told(3, told(0), 0.0)
    assert kept.best(1.5)[3] == 1
    assert kept[Name(GOAL, (2, 0))].message.after == (0, 0), "nobody waits for it"
    assert chosen(kept, 1.5) == 2


def test_where_room_is_full_the_oldest_go() -> None:
    _, kept = at_robot_2(most=2)
    keep(kept, 1, 2, 3)
    kept.told(3, told(0), 0.0)
    assert chosen(kept, 0.0) == 2
    assert Name(GOAL, (1, 0)) not in kept


def test_a_robot_that_starts_again_has_told_nothing() -> None:
    _, kept = at_robot_2()
    keep(kept, 1)
    kept.told(3, told(0), 0.0)
    kept.started(3)
    assert chosen(kept, 0.1) is None


def test_a_lower_number_takes_the_place_of_false_ones() -> None:
    _, kept = at_robot_2()
    keep(kept, 900, 5)
    kept.told(3, told(0), 0.0)
    assert chosen(kept, 0.0) == 5
    assert Name(GOAL, (900, 0)) not in kept
