"""Explains the result of a run, in sentences computed from its ledger and its trace.

Invariant: every number in a sentence is computed here from the recorded data; a sentence whose numbers do not apply is
left out.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from gr_ros2.link.lateness import LATE_S
from gr_ros2.link.ledger_rows import ROWS, LedgerRow, arrived, row_order
from gr_ros2.record.result import Result, air_uses
from gr_ros2.record.trace import Ints, Packets, Trace
from gr_ros2.report.table import milliseconds

_KINDS = {"new": "new messages", "repair": "repair", "report": "reports", "hello": "hellos"}
_TREND = 1.5
"""A latency that changes by less than this factor from the first to the last deliveries counts as unchanged."""


def explanation(result: Result, trace: Trace) -> list[str]:
    """Sentences about the messages, the capacity of the link, the packets, the latency and the computer's lateness."""
    packets = trace.packets()
    return [
        *_outcome(result),
        *_capacity(result, trace, packets),
        *_packets(result, packets),
        *_in_flight(trace, packets),
        *_trend(trace),
        *repair_lines(result),
        *_lateness(result),
    ]


def _outcome(result: Result) -> Iterator[str]:
    ledger: Counter[str] = Counter()
    for topic in result.topics:
        ledger.update(topic.ledger)
    sent = ledger.total()
    if not sent:
        yield "No message was sent."
        return
    parts = [
        f"{ledger[row]:,} ({_percent(ledger[row] / sent)}) {ROWS[row].words if row in ROWS else row.replace('_', ' ')}"
        for row in dict.fromkeys([LedgerRow.DELIVERED, *row_order([ledger])])
    ]
    yield f"Of {sent:,} messages sent: {', '.join(parts)}."


def _capacity(result: Result, trace: Trace, packets: Packets) -> Iterator[str]:
    """Compare the packet rate that all messages would have needed with the capacity of the link."""
    airtime = result.phy.get("airtime_mean_s") or result.phy.get("airtime_s")
    if not airtime or not result.duration_s or result.config.get("time") == "unthrottled" or not len(packets.packet):
        return
    needed = sum(
        (m.row != LedgerRow.TOO_LARGE).sum() * _entries_per_message(packets, m.topic) for m in trace.messages()
    )
    needed *= len(packets.times()[0]) / len(packets.packet)  # entries share packets
    channels = result.phy.get("channels", 1)
    share = needed * airtime / result.duration_s / channels
    each = "" if channels == 1 else f" on its {channels} channels"
    yield (
        f"A packet takes {milliseconds(airtime)} ms of air, so the link carries at most {channels / airtime:,.1f} "
        f"packets/s{each}. "
        f"All messages sent, cut and packed as they were, come to {needed / result.duration_s:,.1f} packets/s: "
        + (f"{share:.1f} times what the link has." if share > 1 else f"{_percent(share)} of what the link has.")
    )


def _packets(result: Result, packets: Packets) -> Iterator[str]:
    t_sent, t_received = packets.times()
    if not len(t_sent):
        return
    here = np.flatnonzero(~np.isnan(t_received))
    came = len(here)
    passed = int(here[-1]) + 1 if came else 0  # later packets may still be on their way
    what = "packets with new messages" if air_uses(result) else "packets"
    text = (
        f"Of {len(t_sent):,} {what} that left the source, {came:,} ({_percent(came / len(t_sent))}) reached the "
        f"sink intact, {passed - came:,} were lost on the way and {len(t_sent) - passed:,} had not come out of the "
        "PHY by the end"
    )
    if result.phy.get("airtime_s") and result.config.get("time") != "unthrottled" and came:
        span = max(result.duration_s, float(np.nanmax(t_received)))
        used = (
            came * (result.phy.get("airtime_mean_s") or result.phy["airtime_s"]) / span / result.phy.get("channels", 1)
        )
        text += f"; those that arrived took {_percent(used)} of the air"
    yield text + "."
    wanted, complete, whole = _fragments(packets, passed)
    if whole and came < passed:
        unrepaired = " without repair" if air_uses(result) else ""
        yield (
            f"A message had {wanted:.1f} fragments on average and needs every one: of {whole:,} messages that left "
            f"whole {complete:,} ({_percent(complete / whole)}) arrived complete{unrepaired}; had the same share of "
            f"packets been lost at random, {_percent((came / passed) ** wanted)} would have."
        )


def repair_lines(result: Result) -> Iterator[str]:
    """What repair did, and what the air was used for."""
    uses = air_uses(result)
    if not uses:
        return
    ledger: Counter[str] = Counter()
    for topic in result.topics:
        ledger.update(topic.ledger)
    repaired, given_up = ledger[LedgerRow.REPAIRED], ledger[LedgerRow.GIVEN_UP]
    if repaired or given_up:
        yield (
            f"Repair recovered {repaired:,} messages ({_percent(repaired / ledger.total())} of those sent) that had "
            f"lost a packet; {given_up:,} were given up."
        )
    else:
        yield "No message needed repair."
    spent = ", ".join(f"{use.packets:,} for {_KINDS[use.kind]} ({_percent(use.share)})" for use in uses)
    delivered = arrived(ledger)
    per_message = f"; {result.packets['sent'] / delivered:.2f} packets for each message delivered" if delivered else ""
    yield f"Packets sent, and their share of the air used: {spent}{per_message}."


def _in_flight(trace: Trace, packets: Packets) -> Iterator[str]:
    """Where the messages in flight were at the end."""
    left: dict[tuple[int, int], int] = {}
    for src_id, serial, total in _messages_sent(packets)[0]:
        left[src_id, serial] = total
    waiting = under_way = gone = 0
    counts = Counter(zip(packets.src_id.tolist(), packets.serial.tolist(), strict=True))
    for messages in trace.messages():
        for serial in messages.serial[messages.row == LedgerRow.IN_FLIGHT].tolist():
            key = (messages.src_id, serial)
            sent = counts.get(key, 0)
            if not sent:
                waiting += 1
            elif sent < left[key]:
                under_way += 1
            else:
                gone += 1
    if waiting + under_way + gone:
        yield (
            f"Of the messages in flight at the end, {gone:,} had left the source whole and waited in the PHY or on the "
            f"air, {under_way:,} had left in part, and {waiting:,} had not left the source's queue."
        )


def _trend(trace: Trace) -> Iterator[str]:
    """Whether the latency increased during the run."""
    t_sent = np.concatenate([m.t_sent[m.delivered] for m in trace.messages()] or [np.empty(0)])
    t_delivered = np.concatenate([m.t_delivered[m.delivered] for m in trace.messages()] or [np.empty(0)])
    if len(t_sent) < 10:
        return
    latency = (t_delivered - t_sent)[np.argsort(t_delivered, kind="stable")]
    tenth = len(latency) // 10
    first, last = float(np.median(latency[:tenth])), float(np.median(latency[-tenth:]))
    text = (
        f"The median latency was {_seconds(first)} among the first tenth of the deliveries and {_seconds(last)} among "
        "the last: "
    )
    if first > 0 and last / first > _TREND:
        yield text + "messages waited longer and longer."
    elif last > 0 and first / last > _TREND:
        yield text + "the wait became shorter."
    else:
        yield text + "it stayed the same."


def _lateness(result: Result) -> Iterator[str]:
    """Whether the computer kept up with the run's clock."""
    late = result.lateness
    if late is None or not late.moments:
        return
    part, worst = max(late.worst_s.items(), key=lambda item: item[1])
    others = ", ".join(f"{name} {_seconds(value)}" for name, value in late.worst_s.items() if name != part)
    text = (
        f"The computer was up to {_seconds(worst)} late ({part}{'; ' + others if others else ''}), {late.moments:,} "
        f"times by {milliseconds(LATE_S)} ms or more, {_percent(min(late.share, 1.0))} of the run"
    )
    if late.lost:
        text += (
            f"; {_percent(late.lost_after / late.lost)} of the losses follow such moments, as do "
            f"{_percent(late.sent_after / late.sent)} of all messages"
        )
    yield text + "."


def _entries_per_message(packets: Packets, topic: str) -> float:
    totals = packets.total[(packets.topic == topic) & (packets.index == 0)]
    return float(totals.mean()) if len(totals) else 1.0


def _messages_sent(packets: Packets) -> tuple[list[tuple[int, int, int]], Ints, Ints]:
    """For every message with at least one entry sent: (source, serial, total), entries sent, entries that arrived."""
    real = packets.serial >= 0
    keys = np.column_stack([packets.src_id[real], packets.serial[real], packets.total[real]])
    unique, place = np.unique(keys, axis=0, return_inverse=True)
    place = place.ravel()
    sent: Ints = np.bincount(place, minlength=len(unique))
    arrived: Ints = np.bincount(place[~np.isnan(packets.t_received[real])], minlength=len(unique))
    return [(int(a), int(b), int(c)) for a, b, c in unique], sent, arrived


def _fragments(packets: Packets, passed: int) -> tuple[float, int, int]:
    """For the messages that were sent completely within the first ``passed`` packets: their mean number of fragments,
    how many arrived complete, and how many there were."""
    early = packets.packet < passed
    keys, sent, arrived = _messages_sent(
        replace(packets, **{name: values[early] for name, values in vars(packets).items()})
    )
    total = np.array([total for _, _, total in keys], dtype=np.int64)
    whole = sent >= total
    if not whole.any():
        return 0.0, 0, 0
    return float(total[whole].mean()), int((arrived >= total)[whole].sum()), int(whole.sum())


def _percent(share: float) -> str:
    """A percentage with as many digits as are needed to distinguish it from 0 and from 100 %."""
    for digits in range(3):
        text = f"{share:.{digits}%}"
        if share in (0, 1) or float(text[:-1]) not in (0, 100):
            return text
    return f"{share:.1e}" if share < 0.5 else text


def _seconds(value: float) -> str:
    return f"{value:.1f} s" if abs(value) >= 1 else f"{milliseconds(value)} ms"
