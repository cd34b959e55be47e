"""`gr-ros2 replay`: send a recording through a link, and record what arrives."""

from __future__ import annotations

from pathlib import Path

import click

from gr_ros2.cli.console import console as make_console
from gr_ros2.cli.params import Number, set_option
from gr_ros2.core.names import first
from gr_ros2_lab.cli.params import SCENARIO
from gr_ros2_lab.report.explain import air_lines
from gr_ros2_lab.report.table import as_table, ledger_grid, notes, packets_line, summary_grid
from gr_ros2_lab.run.replay import replay as replay_bag
from gr_ros2_lab.run.scenario import Scenario, load_scenario


@click.command()
@click.argument("recording", metavar="IN", type=click.Path(path_type=Path))
@click.argument("target", metavar="OUT", type=click.Path(path_type=Path))
@click.option("--scenario", "name", type=SCENARIO, required=True, help="Whose link: a built-in name or a YAML file.")
@click.option("--topics", help="Names with commas between; the registry is then made of the recording.")
@click.option("--seed", type=int, help="Seed of channel and sender.")
@click.option("--duration", type=Number(), default=0.0, help="Seconds of the recording; default 0 = all of it.")
@set_option(Scenario)
def replay(
    recording: Path,
    target: Path,
    *,
    name: str,
    topics: str | None,
    seed: int | None,
    duration: float,
    overrides: tuple[str, ...],
) -> None:
    """Send the bag IN through a scenario's link and write what arrives as the bag OUT, without ROS and radio.

    IN and OUT are .mcap or .db3 files or bag folders. Names and payloads stay as they are. Only where the
    scenario compresses, alignment gaps, which have no meaning, become zero, and fields named in quantize are rounded.
    In OUT a message's time is that of its arrival (log_time), and in MCAP its original time is the publish_time.
    """
    scenario = load_scenario(name, overrides, seed=seed, duration_s=duration, source=f"bag:{recording}")
    chosen = [f"/{topic.strip().strip('/')}" for topic in (topics or "").split(",") if topic.strip()]
    console = make_console()
    with console.status(f"{recording} through {scenario.name}"):
        done = replay_bag(recording, target, scenario, chosen)
    result = done.outcome.result
    left_out = f"; left out: {', '.join(first(done.left_out))}" if done.left_out else ""
    console.print(f"Carried: {', '.join(done.carried)}{left_out}", soft_wrap=True)
    for line in done.remarks:
        console.print(line, soft_wrap=True, markup=False, highlight=False)
    console.print(f"{packets_line(result)}\n")
    for grid in (summary_grid([result]), ledger_grid(result)):
        console.print(as_table(grid))
    for line in (*air_lines(result), *notes(result)):
        console.print(line)
    console.print(f"\nWritten to {target}", soft_wrap=True)
