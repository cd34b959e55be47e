"""Who makes a robot keep much takes no room of the others."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from gr_ros2.relay.memory import Memory
from gr_ros2.relay.quotas import Quotas

MOST, MOST_BYTES = 12, 100
PUTS = st.lists(st.tuples(st.integers(0, 40), st.integers(1, 3), st.integers(0, 30)))


@given(PUTS)
def test_what_is_kept_is_bounded_and_what_is_lost_is_told(puts: list[tuple[int, int, int]]) -> None:
    quotas: Quotas[int] = Quotas(MOST, Memory(MOST_BYTES).share())
    kept: dict[int, tuple[int, int]] = {}
    for name, robot, size in puts:
        kept[name] = robot, size
        for lost in quotas.put(name, robot, size):
            del kept[lost]
        assert len(kept) <= MOST
        assert sum(size for _, size in kept.values()) <= MOST_BYTES


@given(PUTS)
def test_who_keeps_to_its_share_loses_nothing(puts: list[tuple[int, int, int]]) -> None:
    """Robot 9 has a fourth of the room; the three others bring what they like."""
    quotas: Quotas[int] = Quotas(MOST, Memory(MOST_BYTES).share())
    own = {100 + n: MOST_BYTES // 4 // (MOST // 4) for n in range(MOST // 4)}
    lost = [name for own_name, size in own.items() for name in quotas.put(own_name, 9, size)]
    for name, robot, size in puts:
        lost += quotas.put(name, robot, size)
    assert not own.keys() & set(lost)


def test_the_oldest_is_lost_first_and_what_comes_again_is_new() -> None:
    quotas: Quotas[str] = Quotas(2, Memory(100).share())
    assert quotas.put("a", 1, 1) == quotas.put("b", 1, 1) == quotas.put("a", 1, 1) == []
    assert quotas.put("c", 1, 1) == ["b"]
    quotas.drop("a")
    quotas.drop("never there")
    assert quotas.put("d", 2, 1) == []
    assert quotas.put("e", 2, 101) == ["d", "e"]
