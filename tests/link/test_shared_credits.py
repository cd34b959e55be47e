"""Two endpoints that share the credits of one radio: none is lost, and neither has more than its turn."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from gr_ros2.link.airtime import OUTSTANDING
from gr_ros2.link.shared_credits import ALL, ALONE, SharedCredits

BOTH = {ALL, ALONE}


def test_one_that_sends_alone_uses_every_credit() -> None:
    for which in BOTH:
        shared = SharedCredits(OUTSTANDING)
        for _ in range(100):
            assert shared.of(which) == OUTSTANDING
            assert shared.left(which), "the other one has one less"
            assert shared.grant(1, wanted_by={which}) == [1, 1]


def test_where_both_want_a_credit_they_get_them_in_turn() -> None:
    shared, sent = SharedCredits(), [0, 0]
    for _ in range(100):
        more = shared.grant(1, wanted_by=BOTH)
        assert sorted(more) == [0, 1]
        which = more.index(1)
        assert shared.of(which) == 1
        assert shared.of(1 - which) == 0
        assert not shared.left(which)
        sent[which] += 1
    assert sent == [50, 50]


def test_a_device_that_was_opened_again_gives_all_credits_anew() -> None:
    shared = SharedCredits(OUTSTANDING)
    shared.grant(3, wanted_by=BOTH)
    shared.forget()
    assert [shared.of(which) for which in (ALL, ALONE)] == [0, 0]


@given(
    st.lists(
        st.tuples(st.just("left"), st.sampled_from([ALL, ALONE]))
        | st.tuples(st.just("grant"), st.sets(st.sampled_from([ALL, ALONE])))
    )
)
def test_whatever_happens_neither_has_more_than_was_given_and_somebody_has_the_last(
    steps: list[tuple[str, int]],
) -> None:
    shared, unused = SharedCredits(), 0
    for step, what in steps:
        before = [shared.of(which) for which in (ALL, ALONE)]
        if step == "left":
            less = shared.left(what)
            unused = max(unused - 1, 0)
            assert less == (shared.of(1 - what) < before[1 - what])
        else:
            shared.grant(1, wanted_by=what)
            unused += 1
        now = [shared.of(which) for which in (ALL, ALONE)]
        assert max(now) <= unused <= sum(now)
