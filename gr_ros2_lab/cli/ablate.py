"""`gr-ros2 ablate`: what each part of a link is worth."""

from __future__ import annotations

from pathlib import Path

import click

from gr_ros2.cli.console import console as make_console
from gr_ros2.cli.params import Number, set_option
from gr_ros2_lab.cli.params import OUT_FOLDER, SCENARIO, new_results, written_line
from gr_ros2_lab.report.compare import write_comparison
from gr_ros2_lab.report.table import as_table
from gr_ros2_lab.run.scenario import Scenario
from gr_ros2_lab.study.ablation import Variant, run_variants, worth_grid


@click.command()
@click.argument("scenario", type=SCENARIO)
@click.option("--out", type=OUT_FOLDER, help="Folder for results; default results/ablate-NAME-TIME.")
@click.option("--seed", type=int, help="Seed of robots, channel and sender.")
@click.option("--duration", type=Number(), help="Seconds of each run during which messages are sent.")
@set_option(Scenario)
def ablate(
    scenario: str, out: Path | None, seed: int | None, duration: float | None, overrides: tuple[str, ...]
) -> None:
    """Run SCENARIO as is, then without compression, pull, repair, reports, queue latest: one at a time"""
    out = out or new_results(f"ablate-{Path(scenario).stem}")
    console = make_console()

    def announce(variant: Variant) -> None:
        console.print(f"{variant.name}: " + (", ".join(variant.settings) or "as it is"), soft_wrap=True)

    runs = run_variants(scenario, out, overrides, announce, seed=seed, duration_s=duration)
    grid = worth_grid(runs)
    written = write_comparison(runs, out, [grid])
    console.print(as_table(grid))
    console.print(written_line(written), soft_wrap=True)
