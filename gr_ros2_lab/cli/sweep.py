"""`gr-ros2 sweep`: one scenario at many settings, with a progress bar, tables and figures."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from gr_ros2.cli.console import console as make_console
from gr_ros2.cli.ending import INTERRUPTED
from gr_ros2.cli.params import set_option
from gr_ros2.core.backends import uninterrupted
from gr_ros2.core.errors import BackendMissingError, RunError
from gr_ros2_lab.cli.params import OUT_FOLDER
from gr_ros2_lab.report.table import as_table
from gr_ros2_lab.run.scenario import Scenario
from gr_ros2_lab.study.sweep.definition import builtin_sweeps, load_sweep, read_sweep

if TYPE_CHECKING:
    from gr_ros2_lab.study.sweep.run import SweepProgress

_ESTIMATE_S = 3600.0
"""The time left is estimated from the runs of this period, s. A single run may take minutes."""


@click.command()
@click.argument("sweep", required=False)
@click.option("--out", type=OUT_FOLDER, help="Folder of the sweep; default results/sweep-NAME.")
@click.option("--scheduler", metavar="ADDRESS", help="Run on the Dask cluster of this scheduler, not on this machine.")
@click.option("--workers", type=click.IntRange(1), help="Processes on this machine; default one per core.")
@click.option("--fresh", is_flag=True, help="Run everything again, also what is finished.")
@set_option(Scenario, "one setting of all cells")
def sweep(
    sweep: str | None,
    *,
    out: Path | None,
    scheduler: str | None,
    workers: int | None,
    fresh: bool,
    overrides: tuple[str, ...],
) -> int:
    """Run SWEEP, a built-in name or a YAML file, and draw what comes out; without SWEEP, list the built-in ones.

    A sweep that was stopped goes on with what is left when the same command is given again.
    """
    if sweep is None:
        _list()
        return 0
    plan = load_sweep(sweep, overrides)
    try:
        with uninterrupted():
            from gr_ros2_lab.study.sweep.run import run_sweep
    except ModuleNotFoundError as error:
        package = (error.name or "distributed").split(".")[0]
        raise BackendMissingError(f"sweep needs {package}: pip install 'gr-ros2[sweep]'") from error
    from gr_ros2_lab.study.sweep.summaries import rows_of, summaries
    from gr_ros2_lab.study.sweep.sweep_page import summary_grid

    console = make_console()
    out = out or Path("results") / f"sweep-{plan.name}"
    with _bar(console) as bar:
        task = bar.add_task(plan.name, total=None, note="")

        def advance(progress: SweepProgress) -> None:
            counts = {"found": progress.found, "failed": progress.failed}
            note = ", ".join(f"{count} {name}" for name, count in counts.items() if count)
            bar.update(task, total=progress.total, completed=progress.done + progress.failed, note=note)

        outcome = run_sweep(plan, out, scheduler=scheduler, workers=workers, fresh=fresh, on_progress=advance)
    wanted = sum(len(cell.runs) for cell in plan.cells)
    if outcome.interrupted:
        # After Ctrl-C the prompt returns at once, without seconds of drawing.
        console.print(
            f"stopped with {len(outcome.results)} of {wanted} runs kept in {out}; the same command goes on from there",
            soft_wrap=True,
        )
        return INTERRUPTED
    if outcome.files:
        grid = summary_grid(plan, summaries(plan, rows_of(plan, outcome.results)), (plan.sweep.value,))
        console.print(as_table(grid))
        console.print(f"Written to {out}: {', '.join(path.name for path in outcome.files)}", soft_wrap=True)
    if outcome.failures:
        for line in outcome.failures:
            console.print(f"failed: {line}", soft_wrap=True, markup=False)
        raise RunError(
            f"{plan.name}: {len(outcome.failures)} of {wanted} runs failed; the same command tries them again"
        )
    return 0


def _list() -> None:
    found = {name: read_sweep(name).description for name in builtin_sweeps()}
    width = max(map(len, found))
    for name, description in found.items():
        print(f"{name:{width}}  {description}")


def _bar(console: Console) -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[note]}"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        console=console,
        transient=not console.is_terminal,
        speed_estimate_period=_ESTIMATE_S,
    )
