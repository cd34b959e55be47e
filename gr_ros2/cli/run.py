"""`gr-ros2 demo` and `gr-ros2 run`: one experiment, its progress, its tables and its pictures."""

from __future__ import annotations

import signal
import time
from pathlib import Path
from typing import Any

import click
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from gr_ros2.experiment import runner
from gr_ros2.experiment.figures import latency_figure, path_figure, save_figure
from gr_ros2.experiment.result import Result
from gr_ros2.experiment.scenario import Scenario, load_scenario
from gr_ros2.experiment.table import ledger_table, notes, summary_table

_PLAIN_WIDTH = 110
"""Columns of the tables where the output is no terminal."""

_options = [
    click.option("--out", type=click.Path(path_type=Path), help="Folder for results; default results/NAME-TIME."),
    click.option("--seed", type=int, help="Seed of robots, channel and sender."),
    click.option("--duration", type=float, help="Seconds during which messages are sent; 0 = to the end of a bag."),
    click.option(
        "--set", "overrides", multiple=True, metavar="KEY=VALUE", help="Change one setting, dots between keys."
    ),
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


def _run(name: str, *, out: Path | None, seed: int | None, duration: float | None, overrides: tuple[str, ...]) -> None:
    scenario = load_scenario(name, overrides, seed=seed, duration_s=duration)
    out = out or Path("results") / f"{scenario.name}-{time.strftime('%Y%m%d-%H%M%S')}"
    console = Console(highlight=False)
    if not console.is_terminal:
        console = Console(highlight=False, width=_PLAIN_WIDTH)
    # A service manager's SIGTERM ends a run as Ctrl-C does, with its result written.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    with _bar(console) as bar:
        task = bar.add_task(scenario.name, total=scenario.duration_s or None, sent=0, delivered=0)

        def advance(progress: runner.Progress) -> None:
            done = min(progress.elapsed_s, scenario.duration_s) if scenario.duration_s else progress.elapsed_s
            bar.update(task, completed=done, sent=progress.sent, delivered=progress.delivered)

        outcome = runner.run_scenario(scenario, out, advance)
    pictures = _draw(outcome, out)
    _print(console, scenario, outcome.result)
    console.print(
        f"\nWritten to {out}: result.json, bag {runner.DELIVERED_BAG}/, {', '.join(pictures)}", soft_wrap=True
    )


def _bar(console: Console) -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.fields[sent]} sent, {task.fields[delivered]} delivered"),
        TimeRemainingColumn(),
        console=console,
        transient=not console.is_terminal,
    )


def _draw(outcome: runner.Outcome, out: Path) -> list[str]:
    """Write the pictures; their file names."""
    written: list[str] = []
    for name, (sent, received) in outcome.tracks.items():
        if sent.xy:
            figure = path_figure(sent.xy, received.xy, name, outcome.names.get(name, name))
            stem = "path" if not written else f"path{name.replace('/', '_')}"
            written += [path.name for path in save_figure(figure, out, stem)]
    curves = {topic.topic: topic.latency_cdf_s for topic in outcome.result.topics}
    written += [path.name for path in save_figure(latency_figure(curves), out, "latency")]
    return written


def _print(console: Console, scenario: Scenario, result: Result) -> None:
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
    console.print(summary_table([result]))
    console.print(ledger_table(result))
    for line in notes(result):
        console.print(line)
