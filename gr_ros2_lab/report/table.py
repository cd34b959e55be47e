"""Results as tables: the paper's table 6, delivery and latency, and the loss ledger. The functions do not print.

Invariant: a number that does not apply is shown as a dash.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from rich import box
from rich.markup import escape
from rich.table import Table

from gr_ros2.link.endpoint import without_table
from gr_ros2.link.fates import Fate
from gr_ros2.observe.result import TopicResult
from gr_ros2_lab.record.result import Result, air_uses
from gr_ros2_lab.record.team_numbers import TEAM_VALUES, team_numbers, team_pairs

_DASH = "–"
MOST_PATHS = 2
"""Most paths of which each is drawn in the terminal, and has a line."""
PAPER = "the paper"
"""Name of the authors' own run in the tables."""


@dataclass(frozen=True)
class Grid:
    """A table as text, for both the terminal and HTML.

    :param texts: number of columns from the left that are text; the others are numbers
    :param sections: lines by section
    :param one_line: headings are not broken, and no space surrounds the table
    """

    title: str
    headings: tuple[str, ...]
    sections: tuple[tuple[tuple[str, ...], ...], ...]
    texts: int = 1
    one_line: bool = False


PAPER_TABLE_6 = {"ofdm": ("OFDM", 38.0, 1328, 12, 0.01, 228.6), "direct": ("Direct", 15.0, 452, 452, 1.00, 21767.9)}
"""The paper's table 6 by PHY: config, duration [s], sent, received, PDR, goodput [B/s]."""

PAPER_SCENARIOS = ("paper-ofdm", "paper-ofdm-paced", "paper-direct")
"""Scenarios that repeat the paper's experiments."""

_TABLE_6 = ("Duration [s]", "Sent", "Recv", "PDR", "Goodput [B/s]")


def summary_grid(results: Sequence[Result]) -> Grid:
    """One line per topic: sent, received, PDR and goodput as in the paper's table 6, and latency. Of several runs also
    their names and durations."""
    several = len(results) > 1
    table_6 = slice(None) if several else slice(1, None)
    return Grid(
        "Delivery and latency",
        (*(("Config",) if several else ()), "Topic", *_TABLE_6[table_6], "p50 [ms]", "p95 [ms]", "p99 [ms]"),
        tuple(
            tuple(
                (
                    *((result.scenario,) if several else ()),
                    name,
                    *_table_6(result, topic)[table_6],
                    *(milliseconds(value) for value in (topic.latency_s.p50, topic.latency_s.p95, topic.latency_s.p99)),
                )
                for name, topic in by_receiver(result)
            )
            for result in results
        ),
        texts=2 if several else 1,
    )


def paper_grid(results: Sequence[Result]) -> Grid:
    """The paper's table 6. Below each of its lines is the odometry of the runs with the same kind of PHY."""
    sections = []
    for phy, (config, duration, sent, received, pdr, goodput) in PAPER_TABLE_6.items():
        theirs = (config, PAPER, f"{duration:.1f}", str(sent), str(received), f"{pdr:.2f}", f"{goodput:.1f}")
        ours = [
            (config, result.scenario, *_table_6(result, topic))
            for result in results
            for topic in result.topics
            if result.phy["name"] == phy and topic.type == "nav_msgs/msg/Odometry"
        ]
        sections.append((theirs, *ours))
    return Grid("Table 6 of the paper, and odometry here", ("Config", "Run", *_TABLE_6), tuple(sections), texts=2)


def team_grid(result: Result) -> Grid | None:
    """What all robots of a run together achieved; None where there are none."""
    numbers = team_numbers(result)
    lines = tuple((TEAM_VALUES.get(name, name), f"{value:.3g}") for name, value in numbers.items() if value is not None)
    return Grid("The team", ("Number", "value"), (lines,)) if lines else None


def pairs_grids(result: Result) -> list[Grid]:
    """What was lost, and the mean age, by receiver (lines) and sender (columns), over all topics; [] for less than
    three senders."""
    pairs: dict[str, dict[int, list[TopicResult]]] = {}
    for name, topics in ends(result):
        pairs[name] = {}
        for topic in topics:
            if topic.sent:
                pairs[name].setdefault(topic.src_id, []).append(topic)
    senders = sorted({src_id for at in pairs.values() for src_id in at})
    if len(senders) < 3:
        return []
    return [
        Grid(
            title,
            ("At", *map(str, senders)),
            (tuple((name, *(text(at.get(src_id, ())) for src_id in senders)) for name, at in pairs.items()),),
            one_line=True,
        )
        for title, text in (
            ("Lost of what each robot sent [%]", _lost),
            ("Mean age of what each robot sent [s]", _mean_age),
        )
    ]


def _lost(topics: Sequence[TopicResult]) -> str:
    if not topics:
        return ""
    lost = 100 - 100 * sum(topic.delivered for topic in topics) / sum(topic.sent for topic in topics)
    return f"{lost:.0f}" if lost in (0, 100) or 1 <= lost <= 99 else "<1" if lost < 1 else ">99"


def _mean_age(topics: Sequence[TopicResult]) -> str:
    if not topics:
        return ""
    ages = [topic.age_s.mean for topic in topics if topic.age_s.mean is not None]
    if not ages:
        return _DASH
    age = sum(ages) / len(ages)
    return f"{age:.2f}".removeprefix("0") if age < 0.995 else f"{age:.{1 if age < 9.95 else 0}f}"


def hops_grid(result: Result) -> Grid | None:
    """The pairs of a robot and a topic of another one, by how many robots sent most of its messages on; None where all
    came from the robot itself."""
    groups: dict[int, list[TopicResult]] = {}
    for pair in team_pairs(result):
        if pair.delivered:
            most = max(pair.hops, key=lambda hops: pair.hops[hops], default="0")
            groups.setdefault(int(most), []).append(pair)
    if not any(groups):
        return None
    lines = []
    for hops, pairs in sorted(groups.items()):
        ages = [pair.age_s.mean for pair in pairs if pair.age_s.mean is not None]
        peaks = [pair.age_s.peak for pair in pairs if pair.age_s.peak is not None]
        sent, delivered = sum(pair.sent for pair in pairs), sum(pair.delivered for pair in pairs)
        mean = sum(ages) / len(ages) if ages else None
        texts = f"{delivered / sent:.3f}", number(mean, "{:.2f}"), number(max(peaks, default=None), "{:.2f}")
        lines.append((str(hops) if hops else "0 (heard itself)", str(len(pairs)), str(delivered), *texts))
    headings = ("Robots between", "pairs", "delivered", "PDR", "mean age [s]", "peak age [s]")
    return Grid("By hops", headings, (tuple(lines),))


def ledger_grid(result: Result) -> Grid:
    """The ledger fates of the sent messages of each topic. Fates that are zero for every topic are left out."""
    topics = list(by_receiver(result))
    found = {fate for _, topic in topics for fate, count in topic.ledger.items() if count}
    first = [Fate.DELIVERED, *(fate for fate in (Fate.REPAIRED,) if fate in found)]
    fates = list(dict.fromkeys([*first, *sorted(found)]))
    headings = ["first try" if fate == Fate.DELIVERED and Fate.REPAIRED in found else fate for fate in fates]
    lines = ((name, str(topic.sent), *(str(topic.ledger.get(fate, 0)) for fate in fates)) for name, topic in topics)
    return Grid("Where every sent message went", ("Topic", "sent", *headings), (tuple(lines),))


def air_grid(result: Result) -> Grid | None:
    """What the packets sent were for, and their share of the airtime; None if all carried new messages."""
    uses = air_uses(result)
    if not uses:
        return None
    delivered = sum(topic.delivered for topic in result.topics)
    lines = tuple(
        (use.kind, f"{use.packets:,}", f"{use.share:.1%}", number(each, "{:.2f}"))
        for use in uses
        for each in (use.packets / delivered if delivered else None,)
    )
    return Grid("What the air was used for", ("Packets", "sent", "of the air used", "per message delivered"), (lines,))


def by_receiver(result: Result) -> Iterator[tuple[str, TopicResult]]:
    """Every topic with its name in the tables, which has the receiver where there are several."""
    for name, topics in ends(result):
        yield from ((f"{topic.topic} at {name}" if result.receivers else topic.topic, topic) for topic in topics)


def ends(result: Result) -> Iterator[tuple[str, Sequence[TopicResult]]]:
    """Every receiver: its name, and the topics that it could receive."""
    named = any(receiver.name for receiver in result.receivers)
    own = next((one.get("robot", "") for one in result.config.get("robots", ())), "") if named else ""
    yield own or "receiver 1", result.topics
    yield from ((one.name or f"receiver {one.number}", one.topics) for one in result.receivers)


def whose_view(result: Result) -> str:
    """Whose the numbers of topics and link in a result are, in words; '' where there is one receiver."""
    first, *others = (name for name, _ in ends(result))
    return f"as {first} receives it" if others else ""


def as_table(grid: Grid) -> Table:
    """A grid for the terminal."""
    # The table is narrow, so that ten columns fit a terminal of 80 characters.
    table = Table(
        box=None if grid.one_line else box.SIMPLE_HEAD,
        title=escape(grid.title) or None,
        title_justify="left",
        pad_edge=False,
        collapse_padding=not grid.one_line,
    )
    table.min_width = len(grid.title)  # a title is wrapped to the width of its table
    for place, heading in enumerate(grid.headings):
        if place < grid.texts:
            table.add_column(escape(heading), no_wrap=place == 0, overflow="fold")
        else:
            text = heading if grid.one_line else heading.replace(" ", "\n")
            table.add_column(escape(text), justify="right", no_wrap=True)
    for section in grid.sections:
        for line in section:
            table.add_row(*map(escape, line))
        table.add_section()
    return table


def faults(result: Result) -> list[str]:
    """What is wrong in a run, one line each; often empty."""
    lines = [f"{topic.topic}: {topic.corrupt} messages arrived altered" for topic in result.topics if topic.corrupt]
    counters = result.counters
    counted = [counters, counters.get("back", {}), *counters.get("robots", ())]
    lines += without_table({robot: None for one in counted for robot in one.get("sink", {}).get("no_table", ())})
    lines += result.incomplete
    if result.interrupted:
        lines.append(f"stopped after {result.duration_s:.1f} s")
    return lines


def notes(result: Result) -> list[str]:
    """Remarks for a reader of the tables, one line each: :func:`faults`, and of paths."""
    lines = [_path_note(topic) for topic in result.topics if topic.path_error_m is not None]
    if len(lines) > MOST_PATHS:
        rms, name = max((topic.rms_error_m or 0.0, topic.topic) for topic in result.topics)
        lines = [
            f"Of {len(lines)} received paths, that of {name} is furthest from where its robot was: {rms:.3f} m (RMS)."
        ]
    lines += [
        f"{topic.topic}: {topic.left_out_sent} messages sent and {topic.left_out_received} received have no position "
        "(not finite, beyond 1e9 m, or unreadable) and are left out of the path"
        for topic in result.topics
        if topic.left_out_sent or topic.left_out_received
    ]
    return [*faults(result), *lines]


def packets_line(result: Result) -> str:
    """The packets of a run. What did not happen is left out."""
    counts = [
        f"{count:,} {name.replace('_', ' ')}"
        for name, count in result.packets.items()
        if name in ("sent", "received") or (count and not name.startswith("air_"))
    ]
    return f"Packets of every kind: {', '.join(counts)}."


def paper_results(results: Sequence[Result]) -> list[Result]:
    """Those of the paper's own scenarios."""
    return [result for result in results if result.scenario in PAPER_SCENARIOS]


def _path_note(topic: TopicResult) -> str:
    rms = number(topic.rms_error_m, "{:.3f} m")
    return (
        f"{topic.topic}: the received path deviates from the sent path by {topic.path_error_m:.3f} m; at equal "
        f"times the positions are {rms} apart (RMS)."
    )


def _table_6(result: Result, topic: TopicResult) -> tuple[str, ...]:
    return (
        f"{result.duration_s:.1f}",
        str(topic.sent),
        str(topic.delivered),
        number(topic.pdr, "{:.2f}"),
        number(topic.goodput_Bps, "{:.1f}"),
    )


def milliseconds(seconds: float | None) -> str:
    """A time in ms with about three significant digits."""
    if seconds is None:
        return _DASH
    value = seconds * 1000
    return f"{value:.{2 if abs(value) < 10 else 1 if abs(value) < 100 else 0}f}"


def number(value: float | None, form: str) -> str:
    """The value, or a dash where there is none."""
    return _DASH if value is None else form.format(value)
