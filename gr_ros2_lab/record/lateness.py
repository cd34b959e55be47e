"""How late the computer was in a run that follows the wall clock, and which messages were lost after late moments.

Invariants: lateness is measured, never inferred from losses; a loss follows a late moment if its message was submitted
in that moment or up to ``AFTER_S`` after it. This does not prove a cause; the result therefore also gives the share of
all messages that were submitted at such times.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from gr_ros2.link.fates import Fate
from gr_ros2.link.lateness import Lateness
from gr_ros2_lab.record.result import LatenessResult
from gr_ros2_lab.record.trace import Trace

AFTER_S = 1.0
"""s. After this time, queues that became full in a late moment are empty again, and incomplete messages have been given
up."""


def lateness_result(parts: Mapping[str, Iterable[Lateness]], begin: float, end: float, trace: Trace) -> LatenessResult:
    """The lateness of all parts together, and the messages that were submitted in late moments or after them.

    :param parts: measurements of each part, by name; a part without measurements is left out
    :param begin: s, when submission began; the times of the trace count from there
    :param end: s, when the run was over
    """
    measured = {name: list(several) for name, several in parts.items()}
    worst = {name: max(one.worst for one in several) for name, several in measured.items() if several}
    found = sorted(
        (max(due, begin) - begin, happened - begin)
        for several in measured.values()
        for one in several
        for due, happened in one.moments
        if happened > begin
    )
    moments: list[tuple[float, float]] = []
    for due, happened in found:
        if moments and due <= moments[-1][1]:
            moments[-1] = moments[-1][0], max(happened, moments[-1][1])
        else:
            moments.append((due, happened))
    sent = lost = sent_after = lost_after = 0
    for messages in trace.messages():
        submitted = ~np.isnan(messages.t_sent)
        gone = submitted & ~messages.delivered & (messages.fate != Fate.IN_FLIGHT)
        after = np.zeros(len(submitted), dtype=bool)
        for due, happened in moments:
            after |= (messages.t_sent >= due) & (messages.t_sent <= happened + AFTER_S)
        sent, sent_after = sent + int(submitted.sum()), sent_after + int(after.sum())
        lost, lost_after = lost + int(gone.sum()), lost_after + int((gone & after).sum())
    return LatenessResult(
        worst_s=worst,
        moments=len(moments),
        share=sum(happened - due for due, happened in moments) / max(end - begin, 1e-9),
        lost=lost,
        lost_after=lost_after,
        sent=sent,
        sent_after=sent_after,
    )
