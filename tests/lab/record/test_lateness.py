"""How late the computer was, and what was lost after that, from numbers made up here."""

from __future__ import annotations

from math import nan

import pytest

from gr_ros2.link.fates import Fate
from gr_ros2.link.lateness import Lateness
from gr_ros2_lab.record.ledger import TopicLedger
from gr_ros2_lab.record.trace import Trace, make_trace
from gr_ros2_lab.run.runner import AFTER_S, lateness_result

BEGIN, END = 100.0, 110.0


def late(*moments: tuple[float, float]) -> Lateness:
    made = Lateness()
    for due, happened in moments:
        made.happened(due, happened)
    return made


def trace(*messages: tuple[float, Fate]) -> Trace:
    """Of messages submitted at these times, s since the begin."""
    book = TopicLedger(1, 0)
    for number, (t, fate) in enumerate(messages):
        book.t_sent.append(BEGIN + t)
        book.t_delivered.append(BEGIN + t + 0.1 if fate is Fate.DELIVERED else nan)
        book.hops.append(0 if fate is Fate.DELIVERED else -1)
        book.size.append(100)
        book.serial.append(number)
        book.fate.append(0)
        book.book(number, fate)
    return make_trace([book], logs={}, tracks={}, name_of=lambda *_: "/odom", published_as={}, t0=BEGIN, t_end=END)


def test_losses_in_a_late_moment_and_shortly_after_it_follow_it() -> None:
    moment = (BEGIN + 2, BEGIN + 2.5)
    messages = trace(
        (1.9, Fate.QUEUE_BOUND),  # before
        (2.0, Fate.QUEUE_BOUND),
        (2.4, Fate.DELIVERED),
        (2.5 + AFTER_S, Fate.LOST_FRAGMENTS),
        (2.6 + AFTER_S, Fate.LOST_FRAGMENTS),  # long after
        (2.2, Fate.IN_FLIGHT),  # not lost
        (nan, Fate.TOO_LARGE),  # never submitted
    )
    found = lateness_result({"threads": [late(moment)], "gate": []}, BEGIN, END, messages)
    assert (found.lost, found.lost_after, found.sent, found.sent_after) == (4, 2, 6, 4)
    assert found.moments == 1
    assert found.share == pytest.approx(0.05)
    assert found.worst_s == {"threads": 0.5}


def test_what_is_late_in_several_parts_at_once_is_one_moment() -> None:
    parts = {
        "threads": [late((101, 102), (105, 105.2))],
        "gate": [late((101.5, 102.5)), late((90, 91), (99, 100.5))],  # the last began before the run
    }
    found = lateness_result(parts, BEGIN, END, trace())
    assert found.moments == 3
    assert found.share == pytest.approx((0.5 + 1.5 + 0.2) / 10)
    assert found.worst_s == {"threads": 1.0, "gate": 1.5}
