"""A run in a few lines: what arrived, how old it was, what was worst and why.

Invariants: at most ``MOST_LINES`` lines; every number in them is in the run's result.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from gr_ros2.link.fates import ARRIVED, FATES, Fate, fate_order
from gr_ros2.observe.result import TopicResult
from gr_ros2_lab.record.result import Result
from gr_ros2_lab.record.team_numbers import TEAM_VALUES, ledger_of, team_pairs
from gr_ros2_lab.record.trace import Trace
from gr_ros2_lab.report.explain import air_lines, change_lines, lateness_lines, percent, repair_words, seconds, why
from gr_ros2_lab.report.table import Grid, by_receiver, faults, number

MOST_LINES = 15
_OTHERS = 3
"""Lines that name the run and its radio, and say what was written. Empty ones do not count."""
_TOPICS = 6
"""Most topics that have a line each. Of more, those of which most was lost do."""


def headline(result: Result, trace: Trace) -> list[str]:
    """The lines without the table: the computer's lateness, what the robots achieved, and what was worst and why."""
    pairs, grid = team_pairs(result), topics_grid(result)
    lines = [
        *lateness_lines(result),
        *change_lines(result),
        *_tasks(result),
        _delivered(pairs, repair_words(result)),
        *faults(result),
    ]
    lines += [*_ages(result), *_hopeless(result, pairs)]
    if grid is None:
        lines += _worst(result)
    if ledger_of(pairs)[Fate.IN_FLIGHT] + sum(topic.delivered for topic in pairs) < sum(topic.sent for topic in pairs):
        lines += _lost_packets(result)
    lines += [*why(result, trace), *air_lines(result)]
    return lines[: MOST_LINES - _OTHERS - (0 if grid is None else 1 + len(grid.sections[0]))]


def topics_grid(result: Result) -> Grid | None:
    """A line per topic of a run with few of them; None for others."""
    lines = [
        (
            name,
            f"{topic.delivered} of {topic.sent}",
            *(number(value, "{:.3f}") for value in (topic.latency_s.p50, topic.latency_s.p99, topic.age_s.mean)),
            _lost(topic.ledger, short=True),
        )
        for name, topic in by_receiver(result)
        if topic.sent
    ]
    if not 0 < len(lines) <= _TOPICS:
        return None
    headings = ("Topic", "delivered", "p50 [s]", "p99 [s]", "mean age [s]", "why not")
    return Grid("", headings, (tuple(lines),), one_line=True)


def _tasks(result: Result) -> Iterator[str]:
    for name, value in result.task.items():
        if name == "met":  # a share only where there are several runs
            yield "The robots have met." if value else "The robots have not met."
            continue
        label = TEAM_VALUES.get(name, name).removesuffix("]").split(" [")
        unit = f" {label[1]}" if len(label) > 1 else ""
        known = f"not known after {seconds(result.duration_s)}" if value is None else f"{value:.3g}{unit}"
        yield f"{label[0].capitalize()}: {known}."


def _delivered(pairs: Sequence[TopicResult], repair: str) -> str:
    ledger = ledger_of(pairs)
    sent = ledger.total()
    if not sent:
        return "No message was sent."
    here = sum(ledger[fate] for fate in ARRIVED)
    robots = len({topic.src_id for topic in pairs})
    of = f" of {robots} robots" if robots > 1 else ""
    repaired = f", {percent(ledger[Fate.REPAIRED] / sent)} after {repair}" if ledger[Fate.REPAIRED] else ""
    lost = f"; {_lost(ledger)}" if here < sent else ""
    return f"Delivered: {here:,} of {sent:,} messages{of} ({percent(here / sent)}{repaired}){lost}."


def _ages(result: Result) -> Iterator[str]:
    aged = [(peak, name, topic) for name, topic in by_receiver(result) if (peak := topic.age_s.peak) and topic.sent > 1]
    ages = [topic.age_s.mean for *_, topic in aged if topic.age_s.mean is not None]
    if ages:
        peak, name, _ = max(aged, key=lambda one: one[0])
        mean = f"{seconds(sum(ages) / len(ages))} old in the mean{' of all topics' if len(ages) > 1 else ''}, "
        yield f"What a receiver knew was {mean}at most {seconds(peak)} ({name})."


def _worst(result: Result) -> Iterator[str]:
    worst = sorted((topic.pdr, name, topic) for name, topic in by_receiver(result) if topic.pdr is not None)
    for pdr, name, topic in [worst[0]] if worst and worst[0][0] < 1 else []:
        yield f"Worst: {name}, {topic.delivered} of {topic.sent} ({percent(pdr)}): {_lost(topic.ledger)}."


def _lost_packets(result: Result) -> Iterator[str]:
    """How many packets did not arrive. Where robots relay, many do not hear each other, and need not."""
    counts = [result.packets, *(receiver.packets for receiver in result.receivers)]
    sent, received = (sum(count.get(name, 0) for count in counts) for name in ("sent", "received"))
    if received < sent and result.config.get("relay", "off") == "off":
        where = ", at all receivers together" if result.receivers else ""
        yield f"On the way {percent(1 - received / sent)} of {sent:,} packets were lost{where}."


def _hopeless(result: Result, pairs: Sequence[TopicResult]) -> Iterator[str]:
    """The SNR that the radio needs, where nothing arrived."""
    snr_db, needed_db = result.config.get("channel", {}).get("snr_db"), result.phy.get("half_snr_db")
    if not any(topic.delivered for topic in pairs) and None not in (snr_db, needed_db) and snr_db < needed_db:
        yield (
            f"The channel has {snr_db:g} dB of SNR, and this radio needs about {needed_db:.0f} dB: there half of its "
            "longest packets arrive."
        )


def _lost(ledger: dict[str, int], *, short: bool = False) -> str:
    fates = [fate for fate in fate_order([ledger]) if fate not in ARRIVED]
    return ", ".join(f"{ledger[fate]:,} {_words(fate, short=short)}" for fate in fates)


def _words(fate: str, *, short: bool) -> str:
    return fate.replace("_", " ") if short or fate not in FATES else FATES[fate].words
