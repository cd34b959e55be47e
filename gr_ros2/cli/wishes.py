"""`gr-ros2 topics` and `gr-ros2 want`: what another robot would send, and asking it to."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping
from typing import Any

import click
from rich import box
from rich.markup import escape
from rich.table import Table

from gr_ros2.cli.console import console as make_console
from gr_ros2.cli.control_socket import OFFERS, WANT
from gr_ros2.cli.ending import FAILED
from gr_ros2.cli.params import Number
from gr_ros2.cli.status import ask_link, find_link, json_option, pid_option
from gr_ros2.core.errors import RunError
from gr_ros2.core.watch import wait_until
from gr_ros2.wire import BROADCAST

_PATIENCE_S = 30.0
"""s for which an answer of the other robot is waited for."""
_LOOK_S = 0.2
_UNITS = {"": 1.0, "s": 1.0, "min": 60.0, "h": 3600.0}

robot_argument = click.argument("robot", type=click.IntRange(0, BROADCAST - 1))


class Duration(click.ParamType):
    """A time such as 60, 60s, 5min or 2h, in s."""

    name = "time"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        if isinstance(value, float):
            return value
        found = re.fullmatch(r"(\d+(?:\.\d+)?)\s*(s|min|h|)", value.strip())
        if found is None:
            self.fail(f"{value!r}: write a time such as 60s, 5min or 2h", param, ctx)
        return float(found[1]) * _UNITS[found[2]]


def _until(look: Callable[[], Mapping[str, Any]], done: Callable[[Mapping[str, Any]], bool]) -> Mapping[str, Any]:
    """What is told when it is done, or when the time is over."""
    told: Mapping[str, Any] = {}

    def over() -> bool:
        nonlocal told
        told = look()
        return done(told)

    wait_until(over, _PATIENCE_S, look_s=_LOOK_S)
    return told


@click.command()
@robot_argument
@pid_option
@json_option
def topics(*, robot: int, pid: int | None, as_json: bool) -> None:
    """What ROBOT offers: topics, services and actions that it does not send unless somebody asks (gr-ros2 want).

    Bytes are those of a message as it is sent. A robot measures for two seconds before it answers.
    """
    chosen = find_link(pid)
    ask_link(chosen, OFFERS, {"robot": robot, "anew": True})
    told = _until(lambda: ask_link(chosen, OFFERS, {"robot": robot}), lambda told: told["age_s"] is not None)
    if told["age_s"] is None:
        raise RunError(
            f"robot {robot} has not answered in {_PATIENCE_S:.0f} s: it is out of range, or an older gr-ros2"
        )
    if as_json:
        click.echo(json.dumps(told["rows"]))
    else:
        make_console().print(offer_table(robot, told["rows"]), soft_wrap=True)


def offer_table(robot: int, rows: list[Mapping[str, Any]]) -> Table | str:
    """What a robot offers."""
    if not rows:
        return f"robot {robot} offers nothing (offer: auto in its file offers what it does not send)"
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for column in ("topic", "type", "rate", "bytes", "bytes/s", ""):
        table.add_column(column, justify="right" if column in ("rate", "bytes", "bytes/s") else "left")
    for row in rows:
        rate, size = row["rate"], row["size"]
        states = ["sent now"] * row["wanted"] + ["fits what is free"] * row["fits"]
        table.add_row(
            escape(row["name"]),
            escape(row["type_name"]),
            f"{rate:.3g}/s" if rate else "",
            f"{size:,.0f}" if size else "",
            f"{rate * size:,.0f}" if rate and size else "",
            ", ".join(states),
        )
    return table


@click.command()
@robot_argument
@click.argument("topic")
@click.option("--rate", type=Number(0), default=0.0, help="Messages/s at most; default: as many as come.")
@click.option("--for", "for_s", type=Duration(), default="60s", show_default=True, help="How long, such as 60s or 2h.")
@click.option("--give-up", is_flag=True, help="Want it no more.")
@pid_option
@json_option
def want(*, robot: int, topic: str, rate: float, for_s: float, give_up: bool, pid: int | None, as_json: bool) -> int:
    """Ask ROBOT to send TOPIC, one of gr-ros2 topics ROBOT; a service or an action likewise.

    The running link goes on asking until the time is over. Its robot sends as long as somebody wants the topic.
    """
    chosen = find_link(pid)
    whose = {"robot": robot, "topic": topic}
    if give_up:
        ask_link(chosen, WANT, {**whose, "how": "give_up"})
    else:
        ask_link(chosen, WANT, {**whose, "how": "want", "rate": rate, "for_s": for_s})
    told = _until(
        lambda: ask_link(chosen, WANT, {**whose, "how": "look"}), lambda told: give_up or told["state"] != "asked"
    )
    if as_json:
        click.echo(json.dumps(told))
    else:
        click.echo(f"{topic} of robot {robot} is given up" if give_up else told["words"])
    return 0 if give_up or told["state"] == "sent" else FAILED
