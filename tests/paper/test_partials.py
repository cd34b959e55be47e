"""One owner of incomplete messages: its books always agree."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from gr_ros2.paper.partials import Partial, Partials
from gr_ros2.wire.v0 import EntryV0

TOTAL = 3


def agree(held: Partials) -> None:
    everything = list(held)
    assert held.size == sum(partial.size for partial in everything)
    assert [partial.last for partial in everything] == sorted(partial.last for partial in everything)
    for src_id in range(3):
        mine = [partial for partial in everything if partial.src_id == src_id]
        assert held.size_of(src_id) == sum(partial.size for partial in mine)
        assert not mine or held.oldest(src_id) is mine[0]
        for topic_id in range(2):
            assert set(held.of(src_id, topic_id).values()) == {p for p in mine if p.topic_id == topic_id}
    assert not everything or held.oldest() is everything[0]


@given(st.lists(st.tuples(st.integers(0, 2), st.integers(0, 1), st.integers(0, 1), st.integers(-1, TOTAL - 1))))
def test_books_agree_whatever_comes_and_goes(steps: list[tuple[int, int, int, int]]) -> None:
    held = Partials()
    for now, (src_id, topic_id, entry_id, index) in enumerate(steps):
        partial = held.of(src_id, topic_id).get(entry_id)
        if index < 0:
            if partial is not None:
                assert held.take(partial) is partial
        else:
            if partial is None:
                partial = Partial(src_id, topic_id, entry_id, entry_id, TOTAL, 0)
            missing = TOTAL - len(partial.fragments | {index: b""})
            whole = held.add(partial, EntryV0(topic_id, entry_id, index, TOTAL, bytes([index])), float(now))
            assert whole == (None if missing else b"\0\1\2")
        agree(held)
    for partial in list(held):
        held.take(partial)
    assert held.size == 0
    for src_id in range(3):
        held.forget(src_id)
    assert not any((held._of, held._in_order, held._sizes))
