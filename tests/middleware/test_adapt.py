"""Adaptation of subscriptions, without any middleware."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from gr_ros2.middleware.adapt import REPLAY_S, Adaptation, Replays, agreed, compatible, settle
from gr_ros2.middleware.base import Qos

RELIABLE = Qos("reliable", "volatile")
BEST_EFFORT = Qos("best_effort", "volatile")
LATCHED = Qos("reliable", "transient_local")

offers = st.builds(Qos, st.sampled_from(["reliable", "best_effort"]), st.sampled_from(["volatile", "transient_local"]))


def test_settling_takes_the_strictest_that_all_offer() -> None:
    assert settle(Qos(depth=3), [LATCHED, LATCHED]) == Qos("reliable", "transient_local", 3)
    assert settle(Qos(), [LATCHED, RELIABLE]) == RELIABLE
    assert settle(Qos(), [RELIABLE, BEST_EFFORT]) == BEST_EFFORT
    assert settle(Qos(reliability="reliable"), [BEST_EFFORT]) == RELIABLE


def test_what_dds_does_not_match() -> None:
    assert not compatible(BEST_EFFORT, RELIABLE)
    assert not compatible(RELIABLE, LATCHED)
    assert not compatible(RELIABLE, Qos(deadline_s=1.0))
    assert not compatible(Qos(deadline_s=2.0), Qos(deadline_s=1.0))
    assert compatible(Qos(deadline_s=1.0), Qos(deadline_s=1.0))


def test_a_message_of_one_publisher_does_not_replace_another_ones() -> None:
    brief, long = Qos(depth=1, lifespan_s=0.1, deadline_s=0.5), Qos(depth=1, lifespan_s=3.0, deadline_s=0.2)
    assert agreed([brief]) == brief
    assert agreed([brief, long]) == Qos(depth=0, lifespan_s=3.0)
    assert agreed([brief, Qos(depth=1)]) == Qos(depth=0), "one says for ever"


@given(st.lists(offers, min_size=1))
def test_a_settled_subscription_matches_every_publisher(publishers: list[Qos]) -> None:
    assert all(compatible(offer, settle(Qos(), publishers)) for offer in publishers)


def test_what_is_asked_in_full_joins_at_once_and_stays() -> None:
    adaptation = Adaptation(RELIABLE)
    assert adaptation.consider({}) == RELIABLE
    assert adaptation.consider({b"a": BEST_EFFORT}) is None
    assert not adaptation.adapts("reliability")


def test_adaptive_joins_with_the_first_publisher_and_anew_only_for_one_that_appears() -> None:
    adaptation = Adaptation(Qos())
    assert adaptation.adapts("reliability")
    assert adaptation.adapts("durability")
    assert not adaptation.adapts("deadline")
    assert adaptation.consider({}) is None
    assert adaptation.consider({b"a": LATCHED}) == LATCHED
    assert adaptation.consider({b"a": LATCHED, b"b": LATCHED}) is None
    assert adaptation.consider({b"a": LATCHED, b"b": LATCHED, b"c": BEST_EFFORT}) == BEST_EFFORT
    assert adaptation.consider({b"a": LATCHED}) is None, "a departure is no reason to join anew"
    assert adaptation.consider({}) is None
    assert adaptation.consider({b"d": RELIABLE}) == RELIABLE
    assert adaptation.settled == RELIABLE


def test_what_was_had_before_joining_anew_is_a_replay_once() -> None:
    replays = Replays()
    replays.join(LATCHED, 0.0)
    assert [replays.has(payload, 1.0) for payload in (b"a", b"a", b"b")] == [False] * 3
    replays.join(LATCHED, 10.0)
    assert [replays.has(payload, 10.5) for payload in (b"a", b"a", b"c", b"b")] == [True, True, False, True]
    assert not replays.has(b"b", 10.6), "said again by its publisher"
    assert not replays.has(b"a", 10.0 + REPLAY_S)
    replays.join(RELIABLE, 20.0)
    assert not replays.has(b"a", 20.5), "no past was asked for"
