"""Which message is worth sending: what neighbours are known or taken to have, and by how much it makes them younger."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gr_ros2.core.tuning import Tuning
from gr_ros2.relay.gain import EXPIRES_S, Gains, Stream
from gr_ros2.relay.robots import NEAR_S, OtherRobots
from gr_ros2.wire.control import Newest
from gr_ros2.wire.mac_block import MOST_WEIGHT
from gr_ros2.wire.v1 import TABLE_TOPIC

TUNING = Tuning()

ODOM = Stream(7, 0xCAFE, 0)


def hearing(*neighbours: int, period_s: float = 0.1) -> Gains:
    """Robot 1, which hears these, and has heard robot 7 ten times a second."""
    gains = Gains(1, OtherRobots())
    for number in range(11):
        for neighbour in neighbours:
            gains.neighbour(neighbour, number * period_s)
        gains.message(neighbours[0], ODOM, number, number * period_s)
    return gains


def test_who_has_sent_a_message_needs_it_no_more() -> None:
    assert hearing(2).best(1.0) == (None, 0.0)
    assert hearing(7).best(1.0) == (None, 0.0)


def test_a_neighbour_that_has_heard_nothing_of_a_robot_is_worth_most() -> None:
    gains = hearing(2, 3)
    assert gains.best(1.0) == (ODOM, pytest.approx(TUNING.gain_unknown_s))


def test_the_gain_is_the_time_that_a_neighbour_is_behind() -> None:
    gains = hearing(2, 3)
    gains.told(3, Newest(7, 0xFE, 0, 4))
    assert gains.gain(ODOM, 1.0) == pytest.approx(0.6)
    gains.sent(ODOM, gains.has(ODOM), 1.0)
    assert gains.gain(ODOM, 1.0) == pytest.approx(0.6 * (1 - TUNING.gain_own))


def test_what_was_sent_is_likely_there_until_the_neighbour_tells_that_it_is_not() -> None:
    gains = hearing(2, 3)
    gains.told(3, Newest(7, 0xFE, 0, 9))
    assert gains.lacks(ODOM, 1.0)
    gains.sent(ODOM, gains.has(ODOM), 1.0)
    assert not gains.lacks(ODOM, 1.0)
    assert gains.best(1.0)[0] == ODOM
    gains.told(3, Newest(7, 0xFE, 0, 9))
    assert gains.lacks(ODOM, 1.0)


def test_the_weight_grows_with_the_messages_that_wait_to_be_relayed() -> None:
    gains = hearing(2, 3)
    for topic_id in range(1, 30):
        gains.message(2, Stream(7, 0xCAFE, topic_id), 1, 1.0)
        for _ in range(80):
            gains.best(1.0)
        assert abs(gains.weight - min(max(topic_id + 2 - TUNING.gain_even, 1), MOST_WEIGHT)) <= 1
    gains.neighbour(2, 100.0)
    for now in range(100, 150):
        gains.best(float(now))
    assert gains.weight == 1, "an own message is worth more"


def test_what_a_neighbour_tells_stands_against_belief() -> None:
    gains = hearing(2, 3)
    gains.sent(ODOM, gains.has(ODOM), 1.0)
    gains.told(3, Newest(7, 0xFE, 0, 10))
    assert gains.best(1.0) == (None, 0.0)
    gains.told(3, Newest(7, 0xFE, 0, 0))
    assert gains.gain(ODOM, 1.0) == pytest.approx(1.0)
    gains.told(3, Newest(7, 0xFF, 0, 10))  # another start
    assert gains.gain(ODOM, 1.0) == pytest.approx(1.0)


def test_a_number_that_is_not_here_counts_no_more_than_the_newest() -> None:
    """It may be false, as of a table that an insider made up: the next table has to be sent all the same."""
    gains = hearing(2, 3)
    gains.told(3, Newest(7, 0xFE, 0, 20_000))
    assert not gains.lacks(ODOM, 1.0)
    gains.message(2, ODOM, 15, 1.5)
    assert gains.lacks(ODOM, 1.5)


def test_who_is_named_by_the_sender_is_taken_to_have_heard_it() -> None:
    gains = hearing(2, 3)
    gains.told(3, Newest(7, 0xFE, 0, 10))
    gains.neighbour(2, 1.1, [3], 1)
    gains.message(2, ODOM, 11, 1.1)
    assert 0 < gains.gain(ODOM, 1.1) < 0.05


def test_a_silent_robot_is_no_neighbour_any_more() -> None:
    assert hearing(2, 3).best(1.0 + NEAR_S) == (None, 0.0)


def test_an_older_message_is_not_new_and_another_start_is_another_stream() -> None:
    gains = hearing(2)
    assert not gains.message(3, ODOM, 10, 1.1)
    assert gains.message(3, ODOM._replace(start=1), 0, 1.1)
    assert not gains.message(2, Stream(1, 0, 0), 5, 1.1)  # its own, sent on
    assert gains.has(ODOM) == 10


def test_a_table_that_a_robot_lacks_goes_before_those_that_tell_that_robots_are_still_there() -> None:
    """Where there was no room for all, they starved it for ever."""
    gains = hearing(2, 3, 4)
    lacked, renewed = Stream(7, 0xCAFE, TABLE_TOPIC), Stream(8, 0xCAFE, TABLE_TOPIC)
    for number in (1, 200):
        gains.message(2, lacked, number, 1.0)
        gains.message(2, renewed, number, 1.0)
        for robot in (3, 4):
            gains.told(robot, Newest(8, 0xFE, TABLE_TOPIC, 1))
    gains.told(3, Newest(7, 0xFE, TABLE_TOPIC, 1))
    assert gains.gain(renewed, 1.0) == pytest.approx(2 * TUNING.gain_known_s)
    assert gains.gain(lacked, 1.0) == pytest.approx(TUNING.gain_unknown_s + TUNING.gain_known_s)
    gains.changed(renewed)
    assert gains.gain(renewed, 1.0) > gains.gain(lacked, 1.0)
    for robot in (2, 3, 4):
        gains.neighbour(robot, 100.0)
        gains.told(robot, Newest(7, 0xFE, TABLE_TOPIC, 199))
    assert gains.lacks(lacked, 100.0)
    for robot in (2, 3, 4):
        gains.neighbour(robot, 200.0)
    assert gains.gain(lacked, 200.0) > 2 * TUNING.gain_unknown_s, "they were away, and may have forgotten"


def test_a_table_that_takes_several_packets_counts_for_as_many() -> None:
    weights = []
    for room in (100, 10):
        gains = hearing(2, 3)
        gains.message(2, ODOM._replace(topic_id=TABLE_TOPIC), 1, 1.0)
        for now in range(100):
            gains.best(1.0 + now / 1000, lambda _: 100.0, (), lambda _: True, room)
        weights.append(gains.weight)
    assert weights[0] == 1 < weights[1]


def test_own_messages_compete_with_those_of_others() -> None:
    gains = hearing(2, 3)
    gains.own(0, 5, 1, 1.0)
    assert gains.best(1.0) == (Stream(1, 5, 0), pytest.approx(2 * TUNING.gain_unknown_s))


def test_every_stream_is_told_in_turn() -> None:
    gains = hearing(2)
    for origin in (8, 9):
        gains.message(2, Stream(origin, 0x1234, 3), 70_000, 1.0)
    gains.own(0, 5, 1, 1.0)
    told = [newest.origin for _ in range(3) for newest in gains.tells()]
    assert told == [7, 8, 9, 7, 8, 9]
    assert gains.tells(3)[1] == Newest(8, 0x34, 3, 70_000 & 0xFFFF)


@given(st.lists(st.tuples(st.integers(2, 5), st.integers(0, 9), st.integers(0, 70_000), st.integers(0, 40))))
def test_the_choice_is_something_that_is_here(packets: list[tuple[int, int, int, int]]) -> None:
    gains = Gains(1, OtherRobots())
    newest: dict[Stream, int] = {}
    made: dict[Stream, float] = {}
    now = 0.0
    for via, origin, number, later in packets:
        now += later / 10
        stream = Stream(origin, 0, 0)
        gains.neighbour(via, now, [origin], 3)
        newer = number > newest.get(stream, -1) or now > made[stream] + EXPIRES_S
        assert gains.message(via, stream, number, now) == (origin != 1 and newer)
        if origin != 1 and newer:
            newest[stream], made[stream] = number, now
        best, gain = gains.best(now)
        assert (best is None) == (gain == 0)
        if best is not None:
            assert gains.has(best) == newest[best]
            gains.sent(best, gains.has(best), now)
            assert gains.gain(best, now) < gain


def test_a_robot_that_has_started_again_has_nothing_of_what_it_told() -> None:
    gains = Gains(1, OtherRobots())
    gains.neighbour(2, 1.0)
    gains.neighbour(3, 1.0)
    gains.message(2, ODOM, 10, 1.0)
    gains.told(3, Newest(ODOM.origin, ODOM.start & 0xFF, ODOM.topic_id, 10))
    assert not gains.lacks(ODOM, 1.0)
    gains.started(3)
    assert gains.lacks(ODOM, 1.0)


def test_a_robot_that_sends_seldom_counts_as_a_neighbour_for_longer() -> None:
    gains = Gains(1, OtherRobots(lambda: 4.0))
    gains.neighbour(2, 0.0, [1], 1)
    assert gains.hears(2, 3.9 * NEAR_S)
    assert gains.robots.near(3.9 * NEAR_S) == [2]
    assert not gains.hears(2, 4 * NEAR_S)
