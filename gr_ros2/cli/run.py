"""`gr-ros2 demo` and `gr-ros2 run`: one experiment, its progress, its tables and its report."""

from __future__ import annotations

import signal
import time
from pathlib import Path
from typing import Any

import click
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from rich.text import Text

from gr_ros2.cli.console import console as make_console
from gr_ros2.cli.dashboard import dashboard_option, watchers
from gr_ros2.cli.terminal import path_text
from gr_ros2.experiment import runner
from gr_ros2.experiment.explain import explanation
from gr_ros2.experiment.report import Run, write_report
from gr_ros2.experiment.scenario import Scenario, load_scenario
from gr_ros2.experiment.table import as_table, ledger_table, notes, paper_grid, summary_table

_options = [
    click.option("--out", type=click.Path(path_type=Path), help="Folder for results; default results/NAME-TIME."),
    click.option("--seed", type=int, help="Seed of robots, channel and sender."),
    click.option("--duration", type=float, help="Seconds during which messages are sent; 0 = to the end of a bag."),
    click.option(
        "--set", "overrides", multiple=True, metavar="KEY=VALUE", help="Change one setting, dots between keys."
    ),
    dashboard_option,
]


def _with_options(function: Any) -> Any:
    for option in reversed(_options):
        function = option(function)
    return function


@click.command()
@click.argument("scenario")
@_with_options
def run(scenario: str, **options: Any) -> None:
    """Run SCENARIO, a built-in name or a YAML file, and write its result."""
    _run(scenario, **options)


@click.command()
@_with_options
def demo(**options: Any) -> None:
    """Two simulated robots: the topics of one cross an OFDM link and come out at the other."""
    _run("demo", **options)


def _run(
    name: str,
    *,
    out: Path | None,
    seed: int | None,
    duration: float | None,
    overrides: tuple[str, ...],
    dashboard: str | None,
) -> None:
    scenario = load_scenario(name, overrides, seed=seed, duration_s=duration)
    out = out or Path("results") / f"{scenario.name}-{time.strftime('%Y%m%d-%H%M%S')}"
    console = make_console()
    # A service manager's SIGTERM ends a run as Ctrl-C does, with its result written.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    with watchers(dashboard, console) as onlookers, _bar(console) as bar:
        task = bar.add_task(scenario.name, total=scenario.duration_s or None, sent=0, delivered=0)

        def advance(progress: runner.Progress) -> None:
            done = min(progress.elapsed_s, scenario.duration_s) if scenario.duration_s else progress.elapsed_s
            bar.update(task, completed=done, sent=progress.sent, delivered=progress.delivered)

        outcome = runner.run_scenario(scenario, out, advance, onlookers)
    _print(console, scenario, outcome)
    kept = f"result.json, bag {runner.DELIVERED_BAG}/, the tables messages and packets"
    if outcome.result.interrupted:
        # Who pressed Ctrl-C wants the prompt back, not a second of drawing.
        console.print(f"\nWritten to {out}: {kept}. For the report: gr-ros2 report {out}", soft_wrap=True)
        return
    written = [path.name for path in write_report([Run(out, scenario.name, outcome.result, outcome.trace)], out)]
    console.print(f"\nWritten to {out}: {written[0]}, {kept}, {', '.join(written[1:])}", soft_wrap=True)


def _bar(console: Console) -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.fields[sent]} sent, {task.fields[delivered]} delivered"),
        TimeRemainingColumn(),
        console=console,
        transient=not console.is_terminal,
    )


def _print(console: Console, scenario: Scenario, outcome: runner.Outcome) -> None:
    result = outcome.result
    phy = result.phy
    if phy["sample_rate"]:
        chosen = (
            "" if scenario.phy.sample_rate else f", chosen to carry {scenario.phy.headroom:.0%} of the offered load"
        )
        console.print(
            f"{phy['name']}: {phy['sample_rate']:,.0f} samples/s{chosen}; a packet of {scenario.packet_len} B takes "
            f"{phy['airtime_samples']} samples, {phy['airtime_s'] * 1e3:.2f} ms",
            soft_wrap=True,
        )
    packets = ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in result.packets.items())
    console.print(f"packets: {packets}\n")
    if scenario.name.startswith("paper-"):
        console.print(as_table(paper_grid([result])))
    console.print(summary_table([result]))
    console.print(ledger_table(result))
    for path in outcome.trace.paths():
        title = f"{path.topic} sent (blue), {path.published_as} received (red), m"
        console.print(Text.from_ansi(path_text(path.sent, path.received, title)), soft_wrap=True)
    for line in (*explanation(result, outcome.trace), *notes(result)):
        console.print(line)
