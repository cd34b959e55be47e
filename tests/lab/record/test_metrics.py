"""Numbers of a topic against cases that can be worked out on paper."""

from __future__ import annotations

from array import array
from collections import Counter
from math import nan

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gr_ros2.observe.latency import latency, latency_cdf
from gr_ros2.observe.result import AgeResult, LatencyResult
from gr_ros2_lab.record.ledger import TopicLedger
from gr_ros2_lab.record.metrics import age, age_quantile, age_sawtooth, delivered_bytes, topic_result

_NAMED = {"topic": "/odom", "type": "nav_msgs/msg/Odometry", "path_error_m": None}


def test_nothing_sent_has_no_numbers() -> None:
    numbers = topic_result(TopicLedger(1, 0), duration_s=0, t_end=10, **_NAMED)
    assert (numbers.sent, numbers.delivered, numbers.latency_cdf_s, numbers.negative_latencies) == (0, 0, (), 0)
    assert [numbers.pdr, numbers.goodput_Bps, numbers.latency_clock] == [None] * 3
    assert (numbers.latency_s, numbers.age_s) == (LatencyResult(), AgeResult())


def test_one_lost_of_four() -> None:
    book = TopicLedger(
        src_id=1,
        topic_id=0,
        sent=4,
        fates=Counter(delivered=3, lost_fragments=1),
        t_sent=array("d", [0, 1, 2, 3]),
        t_delivered=array("d", [0.5, nan, 2.5, 2.9]),
        size=array("L", [10, 10, 20, 30]),
    )
    numbers = topic_result(book, duration_s=4, t_end=4, **_NAMED)
    assert (numbers.pdr, numbers.goodput_Bps, delivered_bytes(book)) == (0.75, 15.0, 60)
    assert numbers.latency_s.p50 == numbers.latency_s.max == 0.5
    assert numbers.negative_latencies == 1  # the clock of the last one was off: kept and counted
    assert numbers.latency_cdf_s[0] == pytest.approx(-0.1)


def test_quantiles_are_linear_between_samples() -> None:
    numbers = latency(np.arange(101.0))
    assert numbers is not None
    assert (numbers.p50, numbers.p95, numbers.p99, numbers.max) == (50, 95, 99, 100)
    assert latency_cdf(np.arange(101.0)) == pytest.approx(range(101))


def test_age_of_a_regular_stream() -> None:
    """Every second a message that took 0.25 s: age runs from 0.25 to 1.25 s."""
    sent = np.arange(10.0)
    found = age(sent, sent + 0.25, t_end=10.25)
    assert found is not None
    assert found.mean == pytest.approx(0.75)
    assert found.peak == pytest.approx(1.25)


def test_an_older_message_makes_nothing_younger() -> None:
    in_order = age(np.array([0.0, 5.0]), np.array([1.0, 6.0]), t_end=8)
    with_late_one = age(np.array([0.0, 5.0, 2.0]), np.array([1.0, 6.0, 7.0]), t_end=8)
    assert in_order == with_late_one


def test_age_is_watched_from_the_first_delivery_to_the_end() -> None:
    found = age(np.array([0.0]), np.array([2.0]), t_end=6)
    assert found is not None
    assert (found.mean, found.peak) == (4, 6)
    assert age(np.array([0.0]), np.array([7.0]), t_end=6) is None
    assert age(np.array([]), np.array([]), t_end=6) is None


@given(st.lists(st.tuples(st.floats(0, 50), st.floats(0, 20)), min_size=1, max_size=30), st.floats(60, 100))
def test_age_agrees_with_watching_it(messages: list[tuple[float, float]], t_end: float) -> None:
    sent = np.array([t for t, _ in messages])
    delivered = sent + np.array([took for _, took in messages])
    found = age(sent, delivered, t_end)
    start = delivered.min()
    if found is None:
        assert start >= t_end
        return
    step = (t_end - start) / 20_000
    instants = start + (np.arange(20_000) + 0.5) * step
    ages = instants - np.array([sent[delivered <= t].max() for t in instants[::100]]).repeat(100)
    # Within a stride of 100 instants the newest message may change: allow for what that can shift.
    slack = 100 * step * len(messages) * 120 / (t_end - start) + 200 * step
    assert abs(found.mean - ages.mean()) <= slack
    assert found.peak >= found.mean >= 0


@pytest.mark.parametrize("seed", range(8))
def test_an_age_that_is_not_exceeded_for_a_share_of_the_time(seed: int) -> None:
    draw = np.random.default_rng(seed)
    sent = np.sort(draw.uniform(0, 10, 20))
    delivered = sent + draw.exponential(0.4, 20)
    start, until, newest = age_sawtooth(sent, delivered, 11.0)
    times = np.linspace(start[0], until[-1], 200_001)
    ages = times - newest[np.searchsorted(start, times, "right") - 1]
    for share in (0.0, 0.05, 0.5, 0.95, 1.0):
        found = age_quantile(sent, delivered, 11.0, share)
        assert found == pytest.approx(np.quantile(ages, share), abs=2e-4)
    assert age_quantile(sent[:0], delivered[:0], 11.0, 0.95) is None
