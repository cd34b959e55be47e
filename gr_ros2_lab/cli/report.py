"""`gr-ros2 report`: the HTML report of runs, made again from their files."""

from __future__ import annotations

from pathlib import Path

import click

from gr_ros2_lab.cli.params import OUT_FOLDER, new_results, pictures_option, written_line
from gr_ros2_lab.report.page import read_runs, write_report


@click.command()
@click.argument("directories", nargs=-1, required=True, metavar="DIR...", type=click.Path(path_type=Path))
@pictures_option
@click.option("--out", type=OUT_FOLDER, help="Folder to write; default: DIR, or results/report-TIME.")
def report(directories: tuple[Path, ...], out: Path | None, pictures: bool) -> None:
    """Write report.html of the runs in these folders; of several runs also a table (CSV, Parquet).

    One folder gets its own report, over all its runs where it holds repetitions; several share one, with their
    latencies in one figure.
    """
    runs = read_runs(directories)
    folder = out or (directories[0] if len(directories) == 1 else new_results("report"))
    print(written_line(write_report(runs, folder, pictures=pictures)))
