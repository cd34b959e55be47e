"""What is carried to a robot comes out once and in order, whatever is lost, doubled, late or given up on its way."""

from __future__ import annotations

import random

from hypothesis import given
from hypothesis import strategies as st

from gr_ros2.link.v1 import sequences
from gr_ros2.link.v1.custody import WINDOW
from gr_ros2.link.v1.sequences import Sequences
from gr_ros2.relay.gain import Stream
from gr_ros2.relay.memory import Memory
from gr_ros2.wire.relayed import FIRST_PLACE, PLACES, Relayed

OF = Stream(1, 7, 3)


def message(n: int, waits: int = 0, size: int = 1) -> Relayed:
    """The n-th message of a topic; its origin sends one packet per two of them."""
    return Relayed(1, 7, n // 2, FIRST_PLACE + n % PLACES, 3, 0, bytes(size), dst_id=9, waits=waits)


def take(here: Sequences[int], message: Relayed, n: int) -> bool | None:
    """It comes at once: no false one is in question."""
    return here.take(message, n, 0.0, 0.0)


class Origin:
    """It keeps messages until a receipt or until it gives them up, and hands on any that it keeps at any time. From the
    first that it keeps to the newest that it made there are ``WINDOW``."""

    def __init__(self) -> None:
        self.kept: list[int] = []
        self.made = 0

    @property
    def full(self) -> bool:
        return bool(self.kept) and self.made - self.kept[0] >= WINDOW

    def hand_on(self, n: int) -> Relayed:
        return message(n, n - self.kept[0])


@given(st.integers(0, 1 << 32), st.booleans())
def test_everything_comes_once_and_in_order_unless_it_is_given_up(seed: int, gives_up: bool) -> None:
    """Also where a robot on the way hands a message on much later, when its place has come round."""
    rng = random.Random(seed)
    origin, here = Origin(), Sequences[int](Memory(100_000).share())
    got: list[int] = []
    under_way: list[tuple[int, Relayed]] = []
    over: set[int] = set()
    while origin.made < 400 or origin.kept:
        if origin.made < 400 and not origin.full and rng.random() < 0.6:
            origin.kept.append(origin.made)
            origin.made += 1
        if origin.kept and rng.random() < 0.7:
            n = rng.choice(origin.kept)
            under_way += [(n, origin.hand_on(n))] * rng.choice((0, 1, 1, 2))
        if gives_up and origin.kept and rng.random() < 0.05:
            over.add(origin.kept.pop(rng.randrange(len(origin.kept))))
        if under_way and rng.random() < 0.8:
            n, arrived = under_way.pop(rng.randrange(len(under_way)))
            take(here, arrived, n)
            got += here.due(1, 7)
        if rng.random() < 0.5 and (newest := here.newest(OF)) is not None:
            origin.kept = [n for n in origin.kept if (message(n).number, message(n).place) > newest]
    assert got == sorted(set(got))
    assert set(range(400)) - set(got) <= over


def test_a_robot_that_starts_anew_waits_for_what_its_origin_keeps_and_for_nothing_else() -> None:
    here = Sequences[int](Memory(5000).share())
    assert take(here, message(12, waits=2), 12)
    assert here.due(1, 7) == []
    assert here.newest(OF) is None
    assert take(here, message(10), 10)
    assert here.due(1, 7) == [10]
    assert take(here, message(13, waits=1), 13)  # 11 is given up
    assert here.due(1, 7) == [12, 13]
    assert take(here, message(11), 11) is False
    assert here.newest(OF) == (message(13).number, message(13).place)


def test_what_waits_is_bounded_and_may_come_again() -> None:
    here = Sequences[int](Memory(4500).share())
    assert [take(here, message(n, waits=n, size=300), n) for n in range(1, 6)] == [
        True,
        True,
        True,
        None,
        None,
    ]
    assert take(here, message(0, size=300), 0)
    assert here.due(1, 7) == [0, 1, 2, 3]
    assert take(here, message(4, size=300), 4)
    assert here.due(1, 7) == [4]


def test_topics_are_bounded() -> None:
    here = Sequences[int](Memory(1 << 30).share())
    for start in range(sequences.MOST_STREAMS + 1):
        take(here, message(1, waits=1)._replace(start=start), start)
    assert here.due(1, 0) == []
    assert len(here._all) == sequences.MOST_STREAMS
