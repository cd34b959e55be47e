"""`gr-ros2 spectrum`: what the front end hears while nothing is sent, and where the band is busy."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import click
from rich import box
from rich.console import Group
from rich.table import Table
from rich.text import Text

from gr_ros2.cli.console import console as make_console
from gr_ros2.cli.control_socket import LISTEN, LISTEN_S
from gr_ros2.cli.params import Number, set_option
from gr_ros2.cli.ping import opened
from gr_ros2.cli.status import ask_link, find_link, json_option, pid_option
from gr_ros2.core.backends import uninterrupted
from gr_ros2.core.errors import RunError
from gr_ros2.radio.config import LinkConfig, load_link
from gr_ros2.radio.occupancy import SELDOM, busy_words

_LOOK_S = 0.2
_WIDTH = 40
"""Columns of the bar of the strongest part."""
_LEAST_DB = 20.0
"""dB over the noise for which a bar is as wide as that, at least."""

Told = Mapping[str, Any]


@click.command()
@click.argument("config", type=click.Path(path_type=Path), required=False)
@click.option(
    "--for",
    "for_s",
    type=Number(0, LISTEN_S, min_open=True),
    default=2.0,
    show_default=True,
    help="Seconds to listen.",
)
@pid_option
@json_option
@set_option(LinkConfig)
def spectrum(*, config: Path | None, for_s: float, pid: int | None, as_json: bool, overrides: tuple[str, ...]) -> None:
    """What the front end hears while nothing is sent: power over frequency, and where the band is busy.

    A running link is silent for that time, and then sends again. With the YAML file CONFIG, its front end is opened,
    and nothing is sent.
    """
    if config is None:
        if overrides:
            raise click.UsageError("--set needs CONFIG; the settings of a running link are its own")
        chosen = find_link(pid)
        told = _wait(lambda begins: ask_link(chosen, LISTEN, {"for_s": for_s} if begins else {}))
    else:
        told = _of_file(load_link(config, overrides), for_s)
    if as_json:
        click.echo(json.dumps(told["radios"]))
    else:
        for radio in told["radios"]:
            make_console().print(spectrum_table(radio), soft_wrap=True)


def _of_file(settings: LinkConfig, for_s: float) -> Told:
    with uninterrupted():
        from gr_ros2.phy import PHY
        from gr_ros2.radio import FRONT_ENDS
        from gr_ros2.radio.spectrum import check_listens

    for own in settings.own_radios[:1] if len(settings.own_radios) == 1 else ():  # before a device is opened for it
        check_listens(FRONT_ENDS.load(own.front_end_name), PHY.load(own.phy.name))
    with opened(replace(settings, transmit=False), instrumented=True) as link:

        def look(begins: bool) -> Told:
            link.check()
            if begins:
                link.listening.measure(for_s)
            return link.listening.look()

        return _wait(look)


def _wait(look: Callable[[bool], Told]) -> Told:
    """What has come of listening.

    :param look: asks, and begins to listen where it gets True
    :raises RunError: when nothing was heard that can be used
    """
    told = look(True)
    while told["state"] == "listens":
        time.sleep(_LOOK_S)
        told = look(False)
    if told["state"] != "done":
        raise RunError(told.get("words", "the link has ended"))
    return told


def spectrum_table(radio: Told) -> Group:
    """What one radio has heard."""
    noise, parts = radio["noise_db"], radio["parts"]
    unit, name = (1e6, "MHz") if max(abs(part["from_hz"]) for part in parts) >= 1e6 else (1e3, "kHz")
    most = max(_LEAST_DB, *(part["peak_db"] - noise for part in parts))
    middle = "" if radio["frequency"] is None else f" around {radio['frequency'] / unit:,.6g} {name}"
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for column in (name, "over the noise", "peak", "busy"):
        table.add_column(column, justify="right")
    table.add_column("█ on average, ░ at most", justify="left")
    for part in reversed(parts):
        mean, peak = part["mean_db"] - noise, part["peak_db"] - noise
        wide, wider = (round(max(level, 0.0) / most * _WIDTH) for level in (mean, peak))
        table.add_row(
            f"{(part['from_hz'] + part['to_hz']) / 2 / unit:,.4f}",
            f"{mean:.0f} dB",
            f"{peak:.0f} dB",
            f"{part['busy']:.1%}" if part["busy"] > SELDOM else "",
            Text("█" * wide + "░" * (wider - wide)),
        )
    seen = radio["blocks"] + radio["zeros"] + radio["not_finite"]
    left_out = [
        f"{radio[kind] / seen:.0%} of what it gave {what}, and is left out"
        for kind, what in (("zeros", "are zeros"), ("not_finite", "are no numbers"))
        if radio[kind]
    ]
    return Group(
        f"{radio['front_end']}{middle}, {radio['sample_rate']:,.0f} samples/s; noise {noise:.0f} dB of full scale",
        table,
        busy_words(parts, unit, name),
        *left_out,
    )
