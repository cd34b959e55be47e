"""The live dashboard on the command line: `--dashboard` of a run, and `gr-ros2 dashboard` that opens its page."""

from __future__ import annotations

import logging
import time
import webbrowser
from collections.abc import Iterator
from contextlib import contextmanager
from http.client import HTTPConnection, HTTPException
from typing import TYPE_CHECKING

import click
from rich.console import Console

from gr_ros2.errors import BackendMissingError, ConfigError, RunError

if TYPE_CHECKING:
    from gr_ros2.experiment.watch import Watcher

ADDRESS, PORT = "127.0.0.1", 5006
_ASK_S = 0.5

dashboard_option = click.option(
    "--dashboard",
    is_flag=False,
    flag_value=str(PORT),
    metavar="[ADDRESS:]PORT",
    help=f"Show it live on a web page, at {ADDRESS}:{PORT} unless told otherwise (write --dashboard=PORT).",
)


@contextmanager
def watchers(where: str | None, console: Console) -> Iterator[list[Watcher]]:
    """The onlookers of a run: a dashboard, where one is wanted.

    :param where: value of ``--dashboard``; None for no dashboard
    :raises ConfigError: for a place where nothing can be served
    :raises BackendMissingError: when the package that draws it is not installed
    """
    if where is None:
        yield []
        return
    address, port = parse_place(where)
    try:
        from gr_ros2.dashboard.server import Dashboard
    except ModuleNotFoundError as error:
        package = (error.name or "bokeh").split(".")[0]
        raise BackendMissingError(f"--dashboard needs {package}: pip install 'gr-ros2[dashboard]'") from error
    for name in ("bokeh", "tornado"):  # they warn of every viewer that leaves
        logging.getLogger(name).setLevel(logging.ERROR)
    with Dashboard(address, port) as dashboard:
        console.print(f"live at {dashboard.url}", soft_wrap=True)
        yield [dashboard]


@click.command()
@click.argument("place", default=str(PORT), metavar="[[ADDRESS:]PORT]")
@click.option("--wait", type=click.FloatRange(0), default=0.0, help="Seconds to wait for a run to begin.")
@click.option("--browser/--no-browser", default=True, help="Open it, or only say where it is.")
def dashboard(place: str, wait: float, browser: bool) -> None:
    """Open the page of a run that was started with --dashboard."""
    address, port = parse_place(place)
    deadline = time.monotonic() + wait
    while not _answers(address, port):
        if time.monotonic() >= deadline:
            raise RunError(
                f"{address}:{port}: no dashboard there; start a run with --dashboard={place}, or --wait for it"
            )
        time.sleep(_ASK_S)
    url = f"http://{address}:{port}/"
    click.echo(url)
    if browser:
        webbrowser.open(url)


def parse_place(text: str) -> tuple[str, int]:
    """`5006`, or `192.168.1.5:5006`, or `[::1]:5006`, as address and port.

    :raises ConfigError: for anything else
    """
    address, _, port = text.strip().rpartition(":")
    if not port.isascii() or not port.isdigit() or int(port) > 65535 or (":" in address and address[0] != "["):
        raise ConfigError(f"dashboard = {text!r}: write [ADDRESS:]PORT, such as {PORT} or 0.0.0.0:{PORT}")
    return address.strip("[]") or ADDRESS, int(port)


def _answers(address: str, port: int) -> bool:
    connection = HTTPConnection(address, port, timeout=2)
    try:
        connection.request("GET", "/alive")
        return b'"instance"' in connection.getresponse().read()
    except (OSError, HTTPException):
        return False
    finally:
        connection.close()
