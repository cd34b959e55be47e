"""`gr-ros2 report`: the HTML report, figures and tables of runs, made again from their files."""

from __future__ import annotations

import time
from pathlib import Path

import click

from gr_ros2.report.page import read_runs, write_report


@click.command()
@click.argument("directories", nargs=-1, required=True, metavar="DIR...", type=click.Path(path_type=Path))
@click.option("--out", type=click.Path(path_type=Path), help="Folder to write; default: DIR, or results/report-TIME.")
def report(directories: tuple[Path, ...], out: Path | None) -> None:
    """Write report.html, figures (PNG, SVG) and tables (CSV, Parquet) of the runs in these folders.

    One folder gets its own report, over all its runs where it holds repetitions; several share one, with their
    latencies in one figure.
    """
    runs = read_runs(directories)
    default = directories[0] if len(directories) == 1 else Path("results") / f"report-{time.strftime('%Y%m%d-%H%M%S')}"
    written = write_report(runs, out or default)
    print(f"Written: {written[0]} and {len(written) - 1} files beside it")
