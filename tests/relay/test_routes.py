"""Over whom other robots are reached: the nearest that may be taken, by what was heard lately."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from gr_ros2.relay.robots import STALE_S, OtherRobots
from gr_ros2.relay.routes import Routes

NOTES = st.lists(st.tuples(st.integers(2, 9), st.integers(2, 5), st.integers(0, 63), st.floats(0, 5)), max_size=60)


def anybody(_: int) -> bool:
    return True


def test_the_shortest_way_is_taken() -> None:
    routes = Routes(OtherRobots())
    routes.note(9, 2, 3, 0.0)
    routes.note(9, 3, 1, 0.0)
    assert routes.over(9, 1.0, anybody) == 3
    assert routes.hops(9, 1.0) == 1
    assert routes.over(9, 1.0, lambda via: via != 3) == 2
    assert routes.over(8, 1.0, anybody) is None


def test_a_detour_does_not_lengthen_a_way_that_was_shorter_lately() -> None:
    routes = Routes(OtherRobots())
    routes.note(9, 2, 1, 0.0)
    routes.note(9, 2, 5, 1.0)
    assert routes.hops(9, 1.0) == 1
    routes.note(9, 2, 5, 1.0 + STALE_S)
    assert routes.hops(9, 2.0 + STALE_S) == 5


def test_a_way_of_which_nothing_is_heard_ends() -> None:
    routes = Routes(OtherRobots())
    routes.note(9, 2, 1, 0.0)
    assert routes.over(9, STALE_S, anybody) == 2
    assert routes.over(9, STALE_S + 0.1, anybody) is None


@given(NOTES)
def test_a_way_leads_over_who_was_heard_and_is_no_longer_than_the_last_note(
    notes: list[tuple[int, int, int, float]],
) -> None:
    routes, now, said = Routes(OtherRobots()), 0.0, {}
    for robot, via, hops, later in notes:
        now += later
        routes.note(robot, via, hops, now)
        said[robot, via] = hops
    for robot in range(2, 10):
        way = routes.over(robot, now, anybody)
        hops = routes.hops(robot, now)
        assert (way is None) == (hops is None)
        if way is not None and hops is not None:
            assert (robot, way) in said
            assert hops <= said[robot, way]


def test_a_distance_counts_for_longer_where_robots_send_seldom() -> None:
    routes = Routes(OtherRobots(lambda: 4.0))
    routes.note(9, 2, 1, 0.0)
    assert routes.over(9, 4 * STALE_S, anybody) == 2
    assert routes.over(9, 4 * STALE_S + 0.1, anybody) is None


def test_of_those_over_which_nothing_arrived_each_has_its_turn() -> None:
    """One of two takes all and hands nothing on; the other had started again."""
    routes = Routes(OtherRobots())
    for now in (0.0, 10.0):
        routes.note(9, 2, 1, now)
        routes.note(9, 3, 1, now)
    routes.doubt(9, 3, 11.0)
    assert routes.over(9, 12.0, anybody) == 2
    routes.doubt(9, 2, 12.0)
    assert routes.over(9, 13.0, anybody) == 3
    routes.doubt(9, 3, 13.0)
    assert routes.over(9, 14.0, anybody) == 2
