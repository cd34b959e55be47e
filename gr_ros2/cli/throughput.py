"""`gr-ros2 throughput`: what the link to another robot carries each way, beside the topics that run."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from contextlib import nullcontext
from typing import Any

import click
from rich import box
from rich.live import Live
from rich.table import Table

from gr_ros2.calls.throughput_frames import LONGEST_S
from gr_ros2.cli.console import console as make_console
from gr_ros2.cli.control_socket import MEASURE
from gr_ros2.cli.ending import FAILED
from gr_ros2.cli.status import ask_link, find_link, json_option, pid_option
from gr_ros2.cli.wishes import robot_argument
from gr_ros2.core.errors import RunError

_LOOK_S = 0.5


@click.command()
@robot_argument
@click.option(
    "--for", "for_s", type=click.IntRange(1, LONGEST_S), default=10, show_default=True, help="Seconds for each way."
)
@pid_option
@json_option
def throughput(*, robot: int, for_s: int, pid: int | None, as_json: bool) -> int:
    """What the link to ROBOT carries each way beside the topics that run, and how old these are meanwhile.

    Both robots look at their topics for two seconds; then one fills what they leave of the air, then the other. What is
    sent for it waits for every topic, and airtime limits hold. A radio whose channel other robots share is measured by
    itself.
    """
    chosen, console = find_link(pid), make_console()
    told: Mapping[str, Any] = ask_link(chosen, MEASURE, {"robot": robot, "for_s": for_s})
    shows = console.is_terminal and not as_json
    with Live("", console=console, auto_refresh=False, transient=True) if shows else nullcontext() as live:
        while told["state"] not in ("done", "failed"):
            time.sleep(_LOOK_S)
            told = ask_link(chosen, MEASURE, {})
            if isinstance(live, Live):
                live.update(throughput_table(told), refresh=True)
    if told["state"] == "failed":
        raise RunError(told["words"])
    if as_json:
        click.echo(json.dumps(told))
    else:
        console.print(throughput_table(told), soft_wrap=True)
        if told["words"]:
            console.print(told["words"], soft_wrap=True)
    return 0 if all(way is not None and way["messages"] for _, way in _ways(told)) else FAILED


def throughput_table(told: Mapping[str, Any]) -> Table:
    """What has come of a measurement so far."""
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, title=None if told["state"] == "done" else told["state"])
    for column in ("", "carried", "lost", "topics beside", "their age", "at most", "before"):
        table.add_column(column, justify="right" if column else "left")
    for name, way in _ways(told):
        if way is not None:
            table.add_row(
                name,
                _in(way["Bps"], 1e3, "kB/s"),
                "" if way["lost"] is None else f"{way['lost']:.1%}",
                f"{way['topics_per_s']:.1f}/s" if way["topics_per_s"] else "",
                *(_in(way[age], 1e-3, "ms") for age in ("age_s", "worst_age_s", "quiet_age_s")),
            )
    return table


def _ways(told: Mapping[str, Any]) -> list[tuple[str, Mapping[str, Any] | None]]:
    """What was carried each way, by a name: over any radio, and over each that was measured by itself."""
    over: dict[str, Mapping[str, Any]] = {f" over {name}": each for name, each in told["radios"].items()}
    if not over or told["there"] is not None:
        over = {"": told, **over}
    return [
        (f"{word} robot {told['robot']}{name}", each[way])
        for name, each in over.items()
        for word, way in (("to", "there"), ("from", "back"))
    ]


def _in(value: float | None, unit: float, name: str) -> str:
    return "" if value is None else f"{value / unit:,.3g} {name}"
