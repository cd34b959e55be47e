"""The metrics of one topic, computed from the submission and delivery times of its messages.

Invariants: a number that does not apply is None, never a guess; negative latencies (clock skew) are kept and counted;
all times are seconds on one clock.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from gr_ros2.core.arrays import Floats
from gr_ros2.link.fates import arrived
from gr_ros2.observe.latency import latency, latency_cdf
from gr_ros2.observe.result import AgeResult, LatencyResult, TopicResult
from gr_ros2_lab.record.ledger import TopicLedger


@dataclass(frozen=True, slots=True)
class Age:
    """s: at each instant since the first delivery, now minus the submission time of the newest message delivered."""

    mean: float
    peak: float


def topic_result(book: TopicLedger, duration_s: float, t_end: float, **named: Any) -> TopicResult:
    """The result of one topic.

    :param duration_s: s during which messages were submitted
    :param t_end: s on the ledger's clock, end of the observation of the age: the end of submission
    :param named: its name and type, and what is known of its paths
    """
    t_sent, t_delivered = np.frombuffer(book.t_sent), np.frombuffer(book.t_delivered)
    done = ~np.isnan(t_delivered)
    latencies = np.sort(t_delivered[done] - t_sent[done])
    quantiles, aged = latency(latencies), age(t_sent[done], t_delivered[done], t_end)
    delivered = arrived(book.fates)
    return TopicResult(
        src_id=book.src_id,
        sent=book.sent,
        delivered=delivered,
        pdr=delivered / book.sent if book.sent else None,
        goodput_Bps=delivered_bytes(book) / duration_s if duration_s > 0 else None,
        latency_s=LatencyResult() if quantiles is None else LatencyResult(**asdict(quantiles)),
        latency_clock=None if quantiles is None else "submit",
        latency_cdf_s=latency_cdf(latencies),
        negative_latencies=int((latencies < 0).sum()),
        age_s=AgeResult() if aged is None else AgeResult(**asdict(aged)),
        ledger=dict(sorted(book.fates.items())),
        hops={str(hops): count for hops, count in sorted(Counter(book.hops).items()) if hops >= 0},
        corrupt=book.corrupt,
        repeats_delivered=book.repeats_delivered,
        **named,
    )


def delivered_bytes(book: TopicLedger) -> int:
    """Serialized bytes of the messages delivered."""
    return int(np.array(book.size)[~np.isnan(np.frombuffer(book.t_delivered))].sum())


def age(t_sent: Floats, t_delivered: Floats, t_end: float) -> Age | None:
    """Exact mean and peak of the age of information, computed from its :func:`age_sawtooth`.

    :return: None where nothing was delivered before the end of the observation
    """
    start, until, newest = age_sawtooth(t_sent, t_delivered, t_end)
    if not len(start):
        return None
    low, high = start - newest, until - newest  # age at both ends of each tooth
    lengths = until - start
    return Age(float(((low + high) / 2 * lengths).sum() / lengths.sum()), float(high.max()))


def age_quantile(t_sent: Floats, t_delivered: Floats, t_end: float, share: float) -> float | None:
    """The age of information that it does not exceed for a share of the time, exact as :func:`age`.

    :return: None where nothing was delivered before the end of the observation
    """
    start, until, newest = age_sawtooth(t_sent, t_delivered, t_end)
    if not len(start):
        return None
    low, high = start - newest, until - newest
    # The time for which the age is at most x grows with as many teeth as x lies in: on lines between their ends.
    ends = np.sort(np.concatenate((low, high)))
    teeth = np.searchsorted(np.sort(low), ends[:-1], "right") - np.searchsorted(np.sort(high), ends[:-1], "right")
    below = np.concatenate(([0.0], np.cumsum(teeth * np.diff(ends))))
    wanted = share * below[-1]
    at = min(int(np.searchsorted(below, wanted)), len(below) - 1)
    if at == 0 or below[at] == below[at - 1]:
        return float(ends[at])
    part = (wanted - below[at - 1]) / (below[at] - below[at - 1])
    return float(ends[at - 1] + part * (ends[at] - ends[at - 1]))


def age_sawtooth(t_sent: Floats, t_delivered: Floats, t_end: float) -> tuple[Floats, Floats, Floats]:
    """The age of information is a sawtooth. It rises with slope 1 and falls to ``t_delivered - t_sent`` when a message
    is delivered that is newer than all messages before.

    :param t_sent: s, when each delivered message was submitted, in any order
    :param t_delivered: s, when it was delivered
    :param t_end: s, end of the observation
    :return: for each tooth its start, its end, and the submission time of the newest message delivered by then
    """
    order = np.argsort(t_delivered, kind="stable")
    times, newest = t_delivered[order], np.maximum.accumulate(t_sent[order])
    inside = times < t_end
    times, newest = times[inside], newest[inside]
    return times, np.append(times[1:], t_end)[: len(times)], newest
