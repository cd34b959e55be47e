"""`gr-ros2 demo` and `gr-ros2 run`: one experiment, its progress, its tables and its report."""

from __future__ import annotations

import time
from collections.abc import Callable, Container, Iterable, Iterator, Sequence
from itertools import count
from pathlib import Path
from typing import Any

import click
import numpy as np
import numpy.typing as npt
from rich.console import Console
from rich.measure import Measurement
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from rich.text import Text

from gr_ros2.cli.console import LOG_S
from gr_ros2.cli.console import console as make_console
from gr_ros2.cli.dashboard import audience, dashboard_option
from gr_ros2.cli.ending import FAILED
from gr_ros2.cli.params import Number, set_option
from gr_ros2.cli.recording import pcap_option, recording
from gr_ros2.codecs import CODECS
from gr_ros2.core.backends import uninterrupted
from gr_ros2.observe.capture import PacketCapture
from gr_ros2.observe.observers import RunObserver
from gr_ros2.settings.fields import AUTO
from gr_ros2_lab.cli.params import OUT_FOLDER, SCENARIO, new_results, pictures_option
from gr_ros2_lab.record.repetitions import REPETITIONS_FILE, repetition_folder
from gr_ros2_lab.record.result import Result
from gr_ros2_lab.report.explain import explanation, lateness_lines
from gr_ros2_lab.report.headline import headline, topics_grid
from gr_ros2_lab.report.repetitions import repetition_grid, repetition_summary
from gr_ros2_lab.report.table import (
    MOST_PATHS,
    as_table,
    hops_grid,
    ledger_grid,
    notes,
    packets_line,
    pairs_grids,
    paper_grid,
    paper_results,
    summary_grid,
    team_grid,
)
from gr_ros2_lab.run import runner
from gr_ros2_lab.run.outcome import Outcome
from gr_ros2_lab.run.scenario import Scenario, load_scenario

_NEXT = (
    "Next: gr-ros2 demo --camera --dashboard (live: what a robot sees, with sliders), plan demo (the forecast), doctor "
    "(what this machine has for a link of your own), link --help"
)

_WIDEST = 1000
"""Columns that no table needs."""

_options = [
    click.option("--out", type=OUT_FOLDER, help="Folder for results; default results/NAME-TIME."),
    click.option("--seed", type=int, help="Seed of robots, channel and sender."),
    click.option("--repetitions", type=click.IntRange(1), help="Runs, with seeds SEED, SEED + 1, ..."),
    click.option("--duration", type=Number(), help="Seconds during which messages are sent; 0 = to the end of a bag."),
    click.option("--details", is_flag=True, help="The tables and sentences of the report, here too."),
    click.option("--no-report", is_flag=True, help="No report; `gr-ros2 report FOLDER` makes it later."),
    pictures_option,
    set_option(Scenario),
    dashboard_option,
    pcap_option,
]
WIDTH, HEIGHT = 78, 22
_DOTS = 2 * (WIDTH - 8), 4 * (HEIGHT - 4)
"""Dots of the area between the axes, which are as far apart both ways."""
_MARKS = 30
"""Marks of the received path."""


def path_text(sent: npt.ArrayLike, received: npt.ArrayLike, title: str) -> str:
    """Transmitted path as blue dots, received as red crosses, axes in metres and of one scale, with terminal colours.

    :param sent: positions (x, y), m, shape (n, 2)
    :param received: the same, in the order of reception
    """
    import plotext  # many runs draw nothing

    plotext.clear_figure()
    plotext.plot_size(WIDTH, HEIGHT)
    plotext.theme("clear")
    plotext.title(title)
    paths = [np.asarray(path, dtype=float).reshape(-1, 2) for path in (sent, received)]
    together = np.concatenate(paths)
    if len(together):
        middle = (together.min(0) + together.max(0)) / 2
        dot_m = max(float((np.ptp(together, axis=0) / _DOTS).max()), 1e-3)
        (left, low), (right, high) = middle - dot_m * np.array(_DOTS) / 2, middle + dot_m * np.array(_DOTS) / 2
        plotext.xlim(left, right)
        plotext.ylim(low, high)
    fewer = paths[1][:: max(len(paths[1]) // _MARKS, 1)]
    for path, color, marker in ((paths[0], "blue", "braille"), (fewer, "red", "x")):
        if len(path):
            plotext.scatter(*path.T.tolist(), color=color, marker=marker)
    return str(plotext.build())


def _with_options(function: Any) -> Any:
    for option in reversed(_options):
        function = option(function)
    return function


@click.command()
@click.argument("scenario", type=SCENARIO)
@_with_options
def run(scenario: str, **options: Any) -> int:
    """Run SCENARIO, a built-in name or a YAML file, and write its result."""
    return _run(scenario, **options)


@click.command()
@click.option("--wire", type=click.Choice(["0", "1"]), default="1", help="Of the wire format; 0 repairs nothing.")
@click.option("--robots", type=click.IntRange(2, 6), help="So many robots that all send, on one channel, in slots.")
@click.option("--camera", is_flag=True, help="What a robot sees: its camera as video, its map, where it is.")
@_with_options
def demo(wire: str, robots: int | None, camera: bool, overrides: tuple[str, ...], **options: Any) -> int:
    """Two simulated robots: the topics of one cross an OFDM link that loses packets, and come out at the other.

    With --robots, that many drive apart among obstacles and tell each other where they are on one channel. With
    --camera and --dashboard, a page shows what one of them sees.
    """
    if camera:
        if wire == "0" or robots is not None:
            raise click.UsageError("--camera: leave --wire and --robots out")
        CODECS.modules("camera")  # says what to install
        return _run("demo-camera", overrides=overrides, **options)
    if robots is not None:
        if wire == "0":
            raise click.UsageError("--robots: version 0 says nothing about slots; leave --wire out")
        return _run("demo-team", overrides=(f"robots={robots}", *overrides), **options)
    older = () if wire == "1" else ("paper={}", "robots=[{direction: send}, {direction: receive}]")
    status = _run("demo", overrides=(*older, *overrides), **options)
    make_console().print(_NEXT, soft_wrap=True)
    return status


def _run(
    name: str,
    *,
    out: Path | None,
    seed: int | None,
    repetitions: int | None,
    duration: float | None,
    details: bool,
    no_report: bool,
    pictures: bool,
    overrides: tuple[str, ...],
    dashboard: str | None,
    pcap: Path | None,
) -> int:
    scenario = load_scenario(name, overrides, seed=seed, repetitions=repetitions, duration_s=duration)
    out = out or new_results(scenario.name)
    console = make_console()
    looked_at = audience(dashboard, console, scenario.name)
    with looked_at as run_observers, recording(PacketCapture, pcap) as captures, _bar(console) as bar:
        seen: list[RunObserver] = [run_observers, *captures]
        if scenario.repetitions == 1:
            outcome = runner.run_scenario(scenario, out, _advance(bar, scenario, scenario.name), seen)
        else:
            turns = (f"{scenario.name} {k} of {scenario.repetitions}" for k in count(1))
            results = runner.run_repetitions(scenario, out, lambda: _advance(bar, scenario, next(turns)), seen)
    drawn = None if no_report else pictures  # None: nothing at all
    if scenario.repetitions == 1:
        _headline(console, scenario, outcome, details=details)
        _report_run(console, outcome, scenario.name, out, drawn)
        results = [outcome.result]
    else:
        _report_repetitions(console, scenario, results, out, drawn, details=details)
    return FAILED if any(result.incomplete for result in results) else 0


def _advance(bar: Progress, scenario: Scenario, title: str) -> Callable[[runner.Progress], None]:
    """A function that shows the progress of a run."""
    how_long = f"{scenario.duration_s:g} s" if scenario.duration_s else "its recording"
    clock = "simulated time, as fast as it can be computed" if scenario.simulated else "real time"
    bar.console.print(f"{title}: {scenario.description or 'an experiment'}; {how_long} of {clock}", soft_wrap=True)
    task = bar.add_task(title, total=scenario.duration_s or None, sent=0, delivered=0)
    shown = time.monotonic()
    begun = False

    def advance(progress: runner.Progress) -> None:
        nonlocal shown, begun
        if not begun:
            begun = True
            bar.console.print(*_graphs(progress.graphs), sep="", end="", soft_wrap=True)
        done = min(progress.elapsed_s, scenario.duration_s) if scenario.duration_s else progress.elapsed_s
        bar.update(task, completed=done, sent=progress.sent, delivered=progress.delivered)
        if not bar.console.is_terminal and time.monotonic() - shown >= LOG_S:
            shown = time.monotonic()
            bar.console.print(
                f"{title}: {done:.1f} s of {how_long}, {progress.sent} sent, {progress.delivered} delivered",
                soft_wrap=True,
            )

    return advance


def _graphs(graphs: Iterable[tuple[str, int | None]]) -> Iterator[str]:
    """How other programs join in, a line each."""
    for what, domain in graphs:
        if domain is not None:
            yield f"ROS_DOMAIN_ID={domain} ROS_LOCALHOST_ONLY=1 ros2 topic list   # {what}\n"


def _report_run(console: Console, outcome: Outcome, name: str, out: Path, drawn: bool | None) -> None:
    kept = f"result.json, bag {runner.DELIVERED_BAG}/, {runner.REGISTRY_FILE}, the tables messages and packets"
    if drawn is None or outcome.result.interrupted:
        # After Ctrl-C the prompt returns at once, without a second of drawing.
        console.print(f"\nWritten to {out}: {kept}. For the report: gr-ros2 report {out}", soft_wrap=True)
        return
    with uninterrupted():  # matplotlib is loaded only when there is something to draw
        from gr_ros2_lab.report.page import Run, write_report
    runs = [Run(out, name, outcome.result, outcome.trace)]
    written = [path.name for path in write_report(runs, out, pictures=drawn)]
    console.print(f"\nWritten to {out}: {', '.join([written[0], kept, *written[1:]])}", soft_wrap=True)


def _report_repetitions(
    console: Console, scenario: Scenario, results: Sequence[Result], out: Path, drawn: bool | None, *, details: bool
) -> None:
    if len(results) < scenario.repetitions:
        console.print(f"stopped after {len(results)} of {scenario.repetitions} runs")
    if not results:
        return
    console.print(as_table((repetition_grid if details else repetition_summary)(results)))
    for number, result in enumerate(results):
        for line in result.incomplete:
            console.print(f"rep-{number}: {line}", soft_wrap=True)
    kept = f"{REPETITIONS_FILE}, the runs in rep-0 to {repetition_folder(out, len(results) - 1).name}"
    if drawn is None or len(results) < scenario.repetitions:
        console.print(f"\nWritten to {out}: {kept}. For the report: gr-ros2 report {out}", soft_wrap=True)
        return
    with uninterrupted():
        from gr_ros2_lab.report.page import read_runs, write_report
    report, *_ = write_report(read_runs([out]), out, pictures=drawn)
    console.print(f"\nWritten to {out}: {report.name}, {kept}", soft_wrap=True)


def _bar(console: Console) -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.fields[sent]} sent, {task.fields[delivered]} delivered"),
        TimeRemainingColumn(),
        console=console,
        transient=not console.is_terminal,
    )


def _headline(console: Console, scenario: Scenario, outcome: Outcome, *, details: bool) -> None:
    """What came of it, in few lines; the tables, the paths and all else behind it if asked for."""
    result = outcome.result
    first = headline(result, outcome.trace)
    late = len(lateness_lines(result))
    for place, line in enumerate(first):
        style = "bold red" if place < late else "bold" if place == late else None
        console.print(line, style=style, soft_wrap=True)
    if not details and (grid := topics_grid(result)) is not None:
        console.print(as_table(grid))
    if details:
        _details(console, outcome, set(first))
    for line in _radio(scenario, result):
        console.print(line, soft_wrap=True)


def _details(console: Console, outcome: Outcome, said: Container[str]) -> None:
    result, paths = outcome.result, list(outcome.trace.paths())
    console.print()
    if paper_results([result]):
        console.print(as_table(paper_grid([result])))
    tables = pairs_grids(result) or [summary_grid([result]), ledger_grid(result)]
    for grid in (*tables, team_grid(result), hops_grid(result)):
        if grid is None:
            continue
        table = as_table(grid)
        width = Measurement.get(console, console.options.update(max_width=_WIDEST), table).maximum
        if grid.one_line and width > console.width:
            console.print(f"{grid.title}: see the report, or widen the terminal to {width} columns", markup=False)
        else:
            console.print(table)
        console.print()
    if len(paths) > MOST_PATHS:
        console.print(f"{len(paths)} paths: see the report")
    for path in paths if len(paths) <= MOST_PATHS else ():
        title = f"{path.topic} sent (dots), {path.published_as} received (x), m"
        console.print(Text.from_ansi(path_text(path.sent, path.received, title)), soft_wrap=True)
    for line in (*notes(result), *explanation(result, outcome.trace), packets_line(result)):
        if line not in said:
            console.print(line, soft_wrap=True)


def _radio(scenario: Scenario, result: Result) -> Iterator[str]:
    """The PHY and what a packet takes on it."""
    phy = result.phy
    if not phy["sample_rate"]:
        return
    chosen = ""
    if scenario.phy.sample_rate == AUTO:
        chosen = (
            f", chosen to carry {scenario.phy.headroom:.0%} of the messages uncompressed, each in packets of its own"
        )
    yield (
        f"Radio: {phy['name']} at {phy['sample_rate']:,.0f} samples/s{chosen}; a full packet of {scenario.packet_len} "
        f"B takes {phy['airtime_s'] * 1e3:.2f} ms."
    )
