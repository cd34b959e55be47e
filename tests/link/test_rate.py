"""The rate that the air allows: nearly the best MCS at every SNR, calm at the edges, robust where nothing is known."""

from __future__ import annotations

import random
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gr_ros2.core.errors import ConfigError
from gr_ros2.core.tuning import Tuning
from gr_ros2.link.rate import Mcs, RateController

TUNING = Tuning()

MCS_TABLE = tuple(
    Mcs(name, airtime_s, half_db, 0.4)
    for name, airtime_s, half_db in (
        ("bpsk, cc", 0.0080, 0.0),
        ("qpsk, cc", 0.0042, 3.0),
        ("16qam, cc", 0.0023, 9.0),
        ("64qam, cc", 0.0017, 14.5),
        ("64qam", 0.0010, 23.0),
    )
)
REPORT_S = 0.02


def settled(snr_db: float, *, reports: int = 200, noise_db: float = 0.0, seed: int = 0) -> list[int]:
    """The MCS after each of some reports of a constant SNR, measured with some error."""
    draw = random.Random(seed)
    rate = RateController(MCS_TABLE, TUNING)
    rate.meet(7)
    rates = [0]
    for number in range(reports):
        now = number * REPORT_S
        rate.report(7, snr_db + draw.gauss(0, noise_db), 1 - MCS_TABLE[rates[-1]].pdr(snr_db), now)
        rates.append(rate.sent([7], now))
    return rates


@given(st.floats(-5, 35))
def test_the_rate_is_nearly_the_best_at_every_snr(snr_db: float) -> None:
    best = max(mcs.goodput(snr_db) for mcs in MCS_TABLE)
    assert MCS_TABLE[settled(snr_db)[-1]].goodput(snr_db) >= 0.9 * best


@settings(max_examples=40, deadline=None)
@given(st.sampled_from(MCS_TABLE[1:]), st.floats(-1.0, 1.5), st.integers(0, 10_000))
def test_at_an_edge_the_rate_is_one_of_two_though_the_snr_is_measured_with_errors(
    faster: Mcs, above_db: float, seed: int
) -> None:
    later = settled(faster.half_db + above_db, noise_db=0.3, reports=1000, seed=seed)[500:]
    changes = sum(one != two for one, two in pairwise(later))
    assert changes <= len(later) / 2, "the most seen in 400 trials was 208"
    assert max(later) - min(later) <= 1


def test_an_snr_that_is_wrong_is_corrected_by_the_losses() -> None:
    rate = RateController(MCS_TABLE, TUNING)
    rate.meet(7)
    mcs = 0
    for number in range(200):
        rate.report(7, 11.0, 0.5 if mcs > 1 else 0.0, number * REPORT_S)  # this radio needs 2 dB more for 16-QAM
        mcs = rate.sent([7], number * REPORT_S)
    assert mcs <= 2
    assert rate.sent([7], 200 * REPORT_S) >= 1


def test_packets_that_were_not_for_a_robot_say_nothing_of_it() -> None:
    rate = RateController(MCS_TABLE, TUNING)
    rate.meet(7)
    for number in range(200):
        rate.report(7, 9.4, 0.75, number * REPORT_S, not_for=0.75)
        rate.sent([7], number * REPORT_S)
    assert rate.chosen(200 * REPORT_S) == {7: 2}
    for number in range(200, 400):
        rate.report(7, 9.4, 0.98, number * REPORT_S, not_for=0.75)
        rate.sent([7], number * REPORT_S)
    assert rate.chosen(400 * REPORT_S)[7] < 2, "of the others it loses nearly all"


def test_a_robot_that_has_not_reported_is_expected_to_lose_all() -> None:
    """And not NaN, which the loss that repairs count on became then."""
    rate = RateController(MCS_TABLE, TUNING)
    assert rate.lost(1, 0, 5.0) == pytest.approx(1.0)
    rate.meet(1)
    assert rate.lost(1, 0, 5.0) == pytest.approx(1.0)


def test_a_packet_for_everybody_serves_the_weakest() -> None:
    rate = RateController(MCS_TABLE, TUNING)
    for robot in (1, 2):
        rate.meet(robot)
    for number in range(100):
        now = number * REPORT_S
        rate.report(1, 30.0, 0.0, now)
        rate.report(2, 5.0, 0.0, now)
    assert (rate.sent([1], now), rate.sent([2], now), rate.sent(None, now)) == (4, 1, 1)
    rate.meet(3)
    assert rate.sent(None, now) == 0, "nothing is known of the third"
    rate.forget(3)
    rate.forget(2)
    assert rate.sent(None, now) == 4


def test_a_robot_that_falls_silent_gets_the_most_robust_rate() -> None:
    rate = RateController(MCS_TABLE, TUNING)
    rate.meet(7)
    for number in range(100):
        rate.report(7, 30.0, 0.0, number * REPORT_S)
    now = 99 * REPORT_S
    assert rate.sent([7], now) == 4
    assert rate.sent([7], now + TUNING.rate_most_silent_s / 2) == 4, "nothing was sent that it could have reported"
    for _ in range(20):
        rate.sent([7], now + TUNING.rate_most_silent_s / 2)
    assert rate.sent([7], now + TUNING.rate_most_silent_s / 2) == 0
    rate.report(7, 30.0, 0.0, now + TUNING.rate_most_silent_s / 2)
    assert rate.sent([7], now + TUNING.rate_most_silent_s / 2) == 4, "it is heard again"
    assert rate.sent([7], now + 2 * TUNING.rate_most_silent_s) == 0


def test_nobody_known_gets_the_most_robust_rate() -> None:
    rate = RateController(MCS_TABLE, TUNING)
    assert rate.sent(None, 0.0) == rate.sent([9], 0.0) == 0


@pytest.mark.parametrize("mcs_table", [(), MCS_TABLE[::-1], (MCS_TABLE[0], MCS_TABLE[0])])
def test_an_mcs_table_goes_up(mcs_table: tuple[Mcs, ...]) -> None:
    with pytest.raises(ConfigError, match="MCS table"):
        RateController(mcs_table, TUNING)


@given(
    st.lists(
        st.tuples(st.sampled_from("rsmf"), st.integers(0, 3), st.floats(-40, 60), st.floats(0, 1), st.floats(0, 2)),
        max_size=60,
    )
)
def test_any_course_of_events_gives_a_rate_of_the_table(events: list[tuple[str, int, float, float, float]]) -> None:
    rate, now = RateController(MCS_TABLE, TUNING), 0.0
    for kind, robot, snr_db, loss, wait in events:
        now += wait
        if kind == "r":
            rate.report(robot, snr_db, loss, now)
        elif kind == "m":
            rate.meet(robot)
        elif kind == "f":
            rate.forget(robot)
        assert rate.sent(None, now) <= rate.sent([robot], now) < len(MCS_TABLE) or not rate.sent([robot], now)


def faded(depth_db: float, *, slope_db_s: float = 150.0, report_s: float = 0.006) -> tuple[RateController, float, int]:
    """A controller whose robot reports an SNR that swings, and then falls from 20 dB: the time of the last report, and
    the MCS after it."""
    rate, now = RateController(MCS_TABLE, TUNING), 0.0
    rate.meet(7)
    for number in range(400):  # the channel is one that changes all the time
        now += report_s
        swing = abs((number * report_s * slope_db_s) % (2 * depth_db) - depth_db)
        rate.report(7, 20.0 - swing, 0.1, now)
        rate.sent([7], now)
    for number in range(6):
        now += report_s
        rate.report(7, 20.0 - slope_db_s * number * report_s, 0.1, now)
        mcs = rate.sent([7], now)
    return rate, now, mcs


def test_in_a_fade_the_rate_goes_down_though_no_report_comes() -> None:
    rate, now, mcs = faded(12.0)
    assert mcs >= 2
    after = [rate.sent([7], now + wait / 1000) for wait in range(1, 52, 3)]
    assert after == sorted(after, reverse=True)
    assert after[0] > after[3] > after[-1] == 0


def test_in_a_constant_channel_the_rate_stays_for_the_same_time() -> None:
    rate = RateController(MCS_TABLE, TUNING)
    rate.meet(7)
    for number in range(400):
        rate.report(7, 20.0, 0.0, number * 0.006)
    assert {rate.sent([7], 399 * 0.006 + wait / 1000) for wait in range(1, 40, 3)} == {3}


def test_after_a_fade_the_rate_rises_with_the_next_report() -> None:
    rate, now, _ = faded(12.0)
    for wait in range(10):
        assert rate.sent([7], now + 0.1 + wait / 1000) <= 1
    rate.report(7, 20.0, 0.2, now + 0.12)
    assert rate.sent([7], now + 0.12) == 3
