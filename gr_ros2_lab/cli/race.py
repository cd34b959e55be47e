"""`gr-ros2 race`: gr-ros2 against DDS and Zenoh over the same radio."""

from __future__ import annotations

from pathlib import Path

import click
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from gr_ros2.cli.console import console as make_console
from gr_ros2.cli.params import Number, OrAuto
from gr_ros2.core.errors import ConfigError
from gr_ros2_lab.cli.params import OUT_FOLDER, new_results
from gr_ros2_lab.report.table import as_table

_SHORT = {"duration_s": 5.0, "loss": (0.05,), "load": (2.0,)}
_TEAM = {"packet_len": 96, "loss": (0.05,), "load": (2.0, 4.0)}
"""Packets carry a block for medium access, and the channel is scarce: below that all contenders carry everything."""

_ROWS = ("steady", "outage-5", "outage-30", "late", "map", "camera")


@click.command()
@click.option("--short", is_flag=True, help="5 s a contender, at load 200 % and loss 5 % unless told otherwise.")
@click.option("--row", type=click.Choice([*_ROWS]), help="What happens beside the odometry; default steady: nothing.")
@click.option("--robots", type=int, metavar="N", help="2 to 10 robots on one channel, all to all; default one to one.")
@click.option("--out", type=OUT_FOLDER, help="Folder for results; default results/race-TIME.")
@click.option("--loss", metavar="PERCENT,...", help="Frames lost, both ways; default 0,5,20,40, of a team 5.")
@click.option(
    "--load", metavar="PERCENT,...", help="Of the channel by messages as they are; 50,200, of a team 200,400."
)
@click.option("--sample-rate", type=OrAuto(click.FLOAT), help="Samples/s instead of --load.")
@click.option("--peers", metavar="NAME,...", help="Who races; default all.")
@click.option("--source", help="sim, a simulated robot's odometry at 35 Hz, or bag:PATH.")
@click.option("--topic", "bag_topic", help="Of the bag, where it has several.")
@click.option("--duration", "duration_s", type=Number(), help="Seconds of the recording; default 15.")
@click.option("--packet-len", type=int, help="Bytes of gr-ros2's longest packets; default 64, of a team 96.")
@click.option("--seed", type=int, help="Of robot, losses and sender.")
def race(
    short: bool, out: Path | None, loss: str | None, load: str | None, peers: str | None, **options: object
) -> None:
    """Carry one recording by gr-ros2, DDS and Zenoh over the same radio, and compare. Needs root."""
    # A race loads figures, tables of files and ROS's types, for which its help does not wait.
    from gr_ros2.settings.config import build
    from gr_ros2_lab.race.race_settings import RaceSettings
    from gr_ros2_lab.race.results import notes, race_grid, write_race
    from gr_ros2_lab.race.rows import ROWS
    from gr_ros2_lab.race.runner import run_race

    given = {
        "loss": None if loss is None else _shares("loss", loss),
        "load": None if load is None else _shares("load", load),
        "peers": None if peers is None else tuple(name.strip() for name in peers.split(",") if name.strip()),
        **options,
    }
    chosen = {name: value for name, value in given.items() if value is not None}
    settings = build(
        RaceSettings,
        {
            **(_TEAM if options["robots"] else ROWS[str(options["row"] or "steady")].settings),
            **(_SHORT if short else {}),
            **chosen,
        },
        "race",
    )
    out = out or new_results("race")
    console = make_console()
    columns = (BarColumn(), MofNCompleteColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=not console.is_terminal) as bar:
        task = bar.add_task("", total=None)

        def show(number: int, total: int, what: str) -> None:
            bar.update(task, completed=number, total=total, description=what)
            if not console.is_terminal:
                console.print(f"{number + 1} of {total}: {what}")

        found = run_race(settings, show)
    if not found.cells:
        raise found.error or KeyboardInterrupt
    written = write_race(found, out)
    console.print(as_table(race_grid(found)))
    for line in notes(found):
        console.print(line, soft_wrap=True, markup=False)
    console.print(f"\nWritten to {out}: {', '.join(path.name for path in written)}", soft_wrap=True)
    if found.error is not None:
        raise found.error


def _shares(name: str, text: str) -> tuple[float, ...]:
    try:
        return tuple(float(part) / 100 for part in text.split(","))
    except ValueError as error:
        raise ConfigError(f"--{name} {text}: write percentages with commas between, such as 0,5,20") from error
