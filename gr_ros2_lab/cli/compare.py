"""`gr-ros2 compare`: runs side by side."""

from __future__ import annotations

from pathlib import Path

import click

from gr_ros2.cli.console import console
from gr_ros2.core.errors import ConfigError
from gr_ros2_lab.cli.params import OUT_FOLDER, new_results, pictures_option, written_line
from gr_ros2_lab.report.compare import compare_grid, lateness_of, write_comparison
from gr_ros2_lab.report.page import read_runs
from gr_ros2_lab.report.table import as_table


@click.command()
@click.argument("directories", nargs=-1, required=True, metavar="DIR DIR...", type=click.Path(path_type=Path))
@pictures_option
@click.option("--out", type=OUT_FOLDER, help="Folder to write; default results/compare-TIME.")
def compare(directories: tuple[Path, ...], out: Path | None, pictures: bool) -> None:
    """Print what differs between the runs in these folders, side by side; write compare.html and a table."""
    runs = read_runs(directories)
    if len(runs) < 2:
        raise ConfigError(f"{directories[0]}: nothing to compare it with; give two folders or more")
    written = write_comparison(runs, out or new_results("compare"), pictures=pictures)
    for line in lateness_of(runs):
        console().print(line, style="bold red", soft_wrap=True)
    console().print(as_table(compare_grid(runs)))
    print(written_line(written))
