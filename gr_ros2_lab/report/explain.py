"""Explains the result of a run, in sentences computed from its ledger and its trace.

Invariant: every number in a sentence is computed here from the recorded data; a sentence whose numbers do not apply is
left out.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Container, Iterator, Mapping
from dataclasses import replace

import numpy as np

from gr_ros2.link.fates import FATES, Fate, fate_order
from gr_ros2.link.lateness import LATE_S
from gr_ros2_lab.record.result import Result, air_uses
from gr_ros2_lab.record.team_numbers import air_span_s, airtime_of_senders, ledger_of, team_pairs
from gr_ros2_lab.record.trace import Ints, Packets, Trace
from gr_ros2_lab.report.table import ends, milliseconds

_NO_REPAIR = "packets that say what is given up"
"""What is sent as repair is sent where repair is off; such a packet may bring one back."""
_KINDS = {"new": "new messages", "repair": "repair", "report": "reports", "hello": "hellos"}
_BEHIND = 0.01
"""A link falls behind if its latency grows by more than this share of the run. Otherwise its queues just fluctuate."""
_ABOVE = 1.05
"""More airtime than this part of the time means that several sent at once."""
_SLOW = 0.01
"""A clock that lags behind real time by more than this share of the run is named."""
_UNSEEN = 0.0005
"""Smaller shares of the air are not named."""
_CHANGES = 6
"""Most changes that are named."""
_CHANNELS = 4
"""Most senders that are named with the use of their channels."""


def explanation(result: Result, trace: Trace) -> list[str]:
    """Sentences about the computer's lateness, the messages, the capacity of the link, the packets and the latency."""
    packets = trace.packets()
    return [
        *lateness_lines(result),
        *change_lines(result),
        *_outcome(result),
        *air_lines(result),
        *_capacity(result, trace, packets),
        *_packets(result, packets),
        *_in_flight(result, trace, packets),
        *_trend(result, trace),
    ]


def change_lines(result: Result) -> list[str]:
    """What somebody changed during the run, in one line; [] for nothing. Of a setting that was drawn from one value to
    another, the last of each second."""
    if not result.changes:
        return []
    last = {(change.setting, int(change.t)): change for change in result.changes}
    said = [f"{change.setting} to {_value(change.value)} at {change.t:.1f} s" for change in last.values()]
    more = f", and {len(said) - _CHANGES} more" if len(said) > _CHANGES else ""
    return [f"Changed while it ran: {', '.join(said[:_CHANGES])}{more}."]


def _value(value: bool | float | None) -> str:
    if value is None or isinstance(value, bool):
        return {None: "none", True: "on", False: "off"}[value]
    return f"{value:g}"


def why(result: Result, trace: Trace) -> list[str]:
    """The sentences that say why messages were lost or late: the capacity of the link, and the latency."""
    return [*_capacity(result, trace, trace.packets()), *_trend(result, trace)]


def _outcome(result: Result) -> Iterator[str]:
    ledger = ledger_of(team_pairs(result))
    sent = ledger.total()
    if not sent:
        yield "No message was sent."
        return
    words = {fate: FATES[fate].words if fate in FATES else fate.replace("_", " ") for fate in fate_order([ledger])}
    words = {Fate.DELIVERED.value: "delivered", **words}
    if Fate.REPAIRED in words:
        words[Fate.DELIVERED.value] = "delivered at the first try"
    parts = [f"{ledger[fate]:,} ({percent(ledger[fate] / sent)}) {what}" for fate, what in words.items()]
    yield f"Of {sent:,} messages sent: {', '.join(parts)}."


def _capacity(result: Result, trace: Trace, packets: Packets) -> Iterator[str]:
    """Whether all messages, cut and packed as those that were sent, would have needed more air than there is."""
    airtime = result.phy.get("airtime_mean_s") or result.phy.get("airtime_s")
    if not airtime or not result.duration_s or not len(packets.packet):
        return
    needed = sum((m.fate != Fate.TOO_LARGE).sum() * _entries_per_message(packets, m.topic) for m in trace.messages())
    needed *= len(packets.times()[0]) / len(packets.packet)  # entries share packets
    # The trace is that of one receiver. Its own messages are taken to be as long as those of the others.
    sent = {(topic.src_id, topic.topic): topic.sent for _, topics in ends(result) for topic in topics}
    needed *= sum(sent.values()) / (sum(topic.sent for topic in result.topics) or 1)
    share = needed * airtime / result.duration_s / result.phy.get("channels", 1)
    if share > 1:
        yield f"The messages do not fit: all of them would have needed {share:.1f} times the air that there is."


def _packets(result: Result, packets: Packets) -> Iterator[str]:
    t_sent, t_received = packets.times()
    if not len(t_sent):
        return
    here = np.flatnonzero(~np.isnan(t_received))
    came = len(here)
    passed = int(here[-1]) + 1 if came else 0  # later packets may still be on their way
    text = f"Of {len(t_sent):,} packets with messages, {came:,} ({percent(came / len(t_sent))}) arrived{_where(result)}"
    if passed - came:
        text += f", {passed - came:,} lost on the way"
    if len(t_sent) - passed:
        text += f", {len(t_sent) - passed:,} left after the last that arrived (lost, or in the PHY at the end)"
    yield text + "."
    wanted, complete, whole = _fragments(packets, passed)
    if wanted > 1.05 and came < passed:
        unrepaired = " without repair" if air_uses(result) else ""
        yield (
            f"A message had {wanted:.1f} fragments on average and needs every one: of {whole:,} messages that left "
            f"whole {complete:,} ({percent(complete / whole)}) arrived complete{unrepaired}; had the same share of "
            f"packets been lost at random, {percent((came / passed) ** wanted)} would have."
        )


def air_lines(result: Result) -> Iterator[str]:
    """Which part of the time the air was in use, and for what."""
    senders = airtime_of_senders(result)
    span = air_span_s(result)
    if senders and span:
        sending = {str(topic.src_id) for topic in result.topics}
        words = repair_words(result)
        told = {src: {words if kind == "repair" else kind: s for kind, s in of.items()} for src, of in senders.items()}
        yield air_line(told, span, sending, shared=result.config.get("duplex") == "half")


def repair_words(result: Result) -> str:
    """What the packets are that count as repair."""
    robots = result.config.get("robots") or [{}]
    off = all({**result.config, **robot}.get("repair") == "off" for robot in robots)
    return _NO_REPAIR if off else "repair"


def air_line(senders: Mapping[str, Mapping[str, float]], span: float, sending: Container[str], *, shared: bool) -> str:
    """Which part of the time the air is in use, and for what.

    :param senders: s of airtime, by source id and kind of packet
    :param span: s from the first packet to the end of the last
    :param sending: source ids that send messages; others only report
    :param shared: whether all use one channel
    """
    together: Counter[str] = Counter()
    for kinds in senders.values():
        together.update(kinds)
    if shared or len(senders) == 1:
        return f"Air in use: {_busy(together, span, several=len(senders) > 1)}."
    if len(senders) > _CHANNELS:
        return f"Air in use, on an average robot's channel: {_busy(together, span * len(senders))}."
    back = [src_id for src_id in senders if src_id not in sending]
    names = {src_id: f"the channel back from receiver {number}" for number, src_id in enumerate(back, 1)}
    if len(back) == 1:
        names[back[0]] = "the channel back"
    each = (
        f"{names.get(src_id, f'the channel of robot {src_id}')} {_busy(kinds, span)}"
        for src_id, kinds in senders.items()
    )
    return f"Air in use: {'; '.join(each)}."


def _busy(kinds: Mapping[str, float], span: float, *, several: bool = False) -> str:
    """Share of the time, with its parts where there are several. Above 1 where robots send at the same time."""
    share = sum(kinds.values()) / span
    together = ", often by several at once" if several and share > _ABOVE else ""
    text = f"{percent(min(share, 1.0))} of the time{together}"
    by_share = sorted(kinds.items(), key=lambda kind: -kind[1])
    parts = [
        (_KINDS.get(kind, kind), part) for kind, spent in by_share if (part := spent / span) > _UNSEEN or part == share
    ]
    if len(parts) > 1:
        return f"{text} ({', '.join(f'{name} {percent(part)}' for name, part in parts)})"
    return f"{text}, with {parts[0][0]}" if parts else text


def _in_flight(result: Result, trace: Trace, packets: Packets) -> Iterator[str]:
    left: dict[tuple[int, int], int] = {}
    for src_id, serial, total in _messages_sent(packets)[0]:
        left[src_id, serial] = total
    waiting = under_way = gone = 0
    counts = Counter(zip(packets.src_id.tolist(), packets.serial.tolist(), strict=True))
    for messages in trace.messages():
        for serial in messages.serial[messages.fate == Fate.IN_FLIGHT].tolist():
            key = (messages.src_id, serial)
            sent = counts.get(key, 0)
            if not sent:
                waiting += 1
            elif sent < left[key]:
                under_way += 1
            else:
                gone += 1
    waited = "waited in the PHY, on the air or for repair" if air_uses(result) else "waited in the PHY or on the air"
    where = {
        f"had left the source whole and {waited}": gone,
        "had left in part": under_way,
        "had not left the source's queue": waiting,
    }
    if parts := [f"{count:,} {what}" for what, count in where.items() if count]:
        yield f"Of the messages in flight at the end{_where(result)}, {', '.join(parts)}."


def _trend(result: Result, trace: Trace) -> Iterator[str]:
    """Whether the link fell behind."""
    t_sent = np.concatenate([m.t_sent[m.delivered] for m in trace.messages()] or [np.empty(0)])
    t_delivered = np.concatenate([m.t_delivered[m.delivered] for m in trace.messages()] or [np.empty(0)])
    if len(t_sent) < 10:
        return
    latency = (t_delivered - t_sent)[np.argsort(t_delivered, kind="stable")]
    tenth = len(latency) // 10
    first, last = float(np.median(latency[:tenth])), float(np.median(latency[-tenth:]))
    if last - first > _BEHIND * result.duration_s:
        yield (
            f"The link fell behind: the median latency{_where(result)} was {seconds(first)} among the first tenth of "
            f"the deliveries and {seconds(last)} among the last."
        )


def _where(result: Result) -> str:
    """Which receiver the trace is of, where there are several."""
    return f" at {next(ends(result))[0]}" if result.receivers else ""


def lateness_lines(result: Result) -> list[str]:
    """Whether the computer kept up with the run's clock: a sentence where it did not."""
    lines = []
    slow_s = result.counters.get("medium", {}).get("slow_s", 0.0)
    if slow_s > _SLOW * result.duration_s:
        lines.append(
            f"The computer carried {len(result.config['robots'])} robots at "
            f"{percent(result.duration_s / (result.duration_s + slow_s))} of real time: "
            f"{seconds(result.duration_s)} on their clock took {seconds(slow_s)} longer. Nothing is lost by it, but "
            "programs on their graphs see a slower world."
        )
    late = result.lateness
    if late is None or not late.moments:
        return lines
    parts = sorted(late.worst_s.items(), key=lambda item: -item[1])
    worst = ", ".join(f"{name} {seconds(value)}" for name, value in parts)
    times = "once" if late.moments == 1 else f"{late.moments:,} times"
    text = (
        f"The computer did not keep up with the clock: {times} it was {LATE_S * 1e3:.0f} ms late or more, for "
        f"{percent(min(late.share, 1.0))} of the run (at most: {worst}); latencies include that"
    )
    if late.lost:
        text += (
            f"; {percent(late.lost_after / late.lost)} of the losses follow such moments, as do "
            f"{percent(late.sent_after / late.sent)} of all messages"
        )
    return [*lines, f"{text}."]


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


def percent(share: float) -> str:
    """A percentage with as many digits as are needed to distinguish it from 0 and from 100 %."""
    for digits in range(3):
        text = f"{share:.{digits}%}"
        if share in (0, 1) or float(text[:-1]) not in (0, 100):
            return text
    return f"{share:.1e}" if share < 0.5 else text


def seconds(value: float) -> str:
    """A time with its unit: in ms below 1 s."""
    return f"{value:.1f} s" if abs(value) >= 1 else f"{milliseconds(value)} ms"
