"""The live dashboard on the command line: `--dashboard` of a new run, and `gr-ros2 dashboard` for a running one."""

from __future__ import annotations

import logging
import socket
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any

import click
from pydantic import Field
from pydantic.dataclasses import dataclass

from gr_ros2.cli.control_socket import ControlSocket, receive, request, running_programs
from gr_ros2.cli.params import Number
from gr_ros2.core.backends import uninterrupted
from gr_ros2.core.errors import BackendMissingError, ConfigError, RunError
from gr_ros2.core.watch import wait_until
from gr_ros2.dashboard.addresses import ANY, exposed, in_url
from gr_ros2.settings.config import STRICT, build

if TYPE_CHECKING:
    from rich.console import Console

    from gr_ros2.cli.console import Lines
    from gr_ros2.dashboard.foxglove import FoxgloveServer
    from gr_ros2.dashboard.server import Dashboard
    from gr_ros2.observe.observers import LateObservers

ADDRESS, PORT = "127.0.0.1", 5006
_ASK_S = 0.5
_ANSWER_S, _ANSWER_BYTES = 2.0, 4096
_log = logging.getLogger(__name__)

dashboard_option = click.option(
    "--dashboard",
    is_flag=False,
    flag_value=str(PORT),
    metavar="[ADDRESS:]PORT",
    help=f"Show it live on a web page, at {ADDRESS}:{PORT} unless told otherwise (write --dashboard=PORT).",
)

FOXGLOVE_PORT = 8765
foxglove_option = click.option(
    "--foxglove",
    is_flag=False,
    flag_value=str(FOXGLOVE_PORT),
    metavar="[ADDRESS:]PORT",
    help=f"Serve its messages to Foxglove, at {ADDRESS}:{FOXGLOVE_PORT} unless told otherwise.",
)


@contextmanager
def foxglove_server(where: str | None, console: Console | Lines) -> Iterator[list[FoxgloveServer]]:
    """The observer that serves a link to Foxglove.

    :param where: value of ``--foxglove``; None for none
    :raises ConfigError: when nothing can be served there
    :raises BackendMissingError: when the SDK is not installed
    """
    if where is None:
        yield []
        return
    from gr_ros2.dashboard.foxglove import FoxgloveServer

    address, port = parse_place(where, "foxglove")
    logging.getLogger("foxglove.websocket").setLevel(logging.CRITICAL)  # it prints invalid messages of clients
    with FoxgloveServer(address, port) as server:
        url = f"ws://{in_url(address)}:{server.port}"
        console.print(f"Foxglove: {url}", soft_wrap=True)
        if exposed(address):
            _log.warning(
                "%s: everybody on the network can see all messages and call services of other robots; leave the "
                "address out to serve this machine only",
                url,
            )
        yield [server]


@dataclass(frozen=True, kw_only=True, config=STRICT)
class _Place:
    """Where a page is asked for."""

    address: str
    port: Annotated[int, Field(ge=0, le=65535)]


@contextmanager
def audience(
    where: str | None,
    console: Console | Lines,
    name: str,
    *,
    answers: Mapping[str, Callable[[Any], Any]] = MappingProxyType({}),
) -> Iterator[LateObservers]:
    """The observers of a run or a link: a dashboard from the start if ``where`` is given, or later when
    `gr-ros2 dashboard` asks for one.

    :param where: value of ``--dashboard``; None for no dashboard at the start
    :param name: what the program is doing, for clients that search for it
    :param answers: what clients may ask of a link beside that, by name; called with the value given, in a thread of its
        own; a run has none
    :raises ConfigError: when the dashboard cannot be served at this place
    :raises BackendMissingError: when the package that draws it is not installed
    """
    from gr_ros2.observe.observers import LateObservers

    seen = LateObservers()
    urls: list[str] = []
    with ExitStack() as dashboards:

        def serve(address: str, port: int) -> str:
            if not urls:
                dashboard = dashboards.enter_context(_make(address, port))
                seen.invite(dashboard)
                urls.append(dashboard.url)
                if dashboard.exposed:
                    _log.warning(
                        "%s: everybody on the network can open this page, change the channel and switch sending off; "
                        "leave the address out to serve it on this machine only",
                        dashboard.url,
                    )
            return urls[0]

        def answer(asked: Mapping[str, Any]) -> dict[str, Any]:
            if set(asked) & {"address", "port"}:
                place = build(_Place, asked, "dashboard")
                return {"url": serve(place.address, place.port)}
            if asked and not answers:
                raise ConfigError(f"{name} is a run, and only a link answers this; gr-ros2 dashboard shows it")
            if strange := sorted(set(asked) - set(answers)):
                known = ", ".join(sorted({"address", "port", *answers}))
                raise ConfigError(f"{', '.join(strange)}: no question here; known are {known}")
            return {key: answers[key](value) for key, value in asked.items()}

        if where is not None:
            console.print(f"live at {serve(*parse_place(where))}", soft_wrap=True)
        # The control socket closes before the dashboards, so that no client can ask for another one then.
        with ExitStack() as control_socket:
            try:
                control_socket.enter_context(ControlSocket(name, answer))
            except (OSError, RunError) as error:
                _log.warning("`gr-ros2 dashboard` cannot find this program (%s)", error)
            yield seen


def _make(address: str, port: int) -> Dashboard:
    try:
        with uninterrupted():
            from gr_ros2.dashboard.server import Dashboard
    except ModuleNotFoundError as error:
        package = (error.name or "bokeh").split(".")[0]
        raise BackendMissingError(
            f"the dashboard needs {package}: apt install gr-ros2-lab, or pip install 'gr-ros2[dashboard]'"
        ) from error
    logging.getLogger("bokeh.protocol").setLevel(logging.CRITICAL)  # it prints invalid messages of viewers
    for name in ("bokeh", "tornado"):  # they warn of every viewer that leaves
        logging.getLogger(name).setLevel(logging.ERROR)
    return Dashboard(address, port)


@click.command()
@click.argument("place", default=str(PORT), metavar="[[ADDRESS:]PORT]")
@click.option("--pid", type=int, help="Process to look at, where several run.")
@click.option("--wait", type=Number(0), default=0.0, help="Seconds to wait for a run to begin.")
@click.option("--browser/--no-browser", default=True, help="Open it, or only say where it is.")
def dashboard(place: str, pid: int | None, wait: float, browser: bool) -> None:
    """Open the live page of a run or a link that goes on in another terminal.

    One that was not started with --dashboard is asked to serve its page at PLACE now.
    """
    address, port = parse_place(place)
    found: list[str] = []

    def find() -> bool:
        url = _find(address, port, pid)
        found.extend([] if url is None else [url])
        return url is not None

    if not wait_until(find, wait, look_s=_ASK_S):
        raise RunError(
            f"{address}:{port}: no dashboard there, and no run or link of yours goes on; start one, or --wait"
        )
    (url,) = found
    click.echo(url)
    if browser:
        import webbrowser

        webbrowser.open(url)


def _find(address: str, port: int, pid: int | None) -> str | None:
    """Address of a page that is served already, or that a running program is asked to serve; None if none runs."""
    if pid is None and _answers(address, port):
        return f"http://{address}:{port}/"
    running = running_programs()
    if pid is None and not running:
        return None
    if pid is None and len(running) > 1:
        several = ", ".join(f"{pid} ({name})" for pid, name in running.items())
        raise ConfigError(f"several run: {several}; say which with --pid")
    chosen = next(iter(running)) if pid is None else pid
    return str(request(chosen, {"address": address, "port": port})["url"])


def parse_place(text: str, what: str = "dashboard") -> tuple[str, int]:
    """Split `5006`, `192.168.1.5:5006` or `[::1]:5006` into address and port.

    :raises ConfigError: for anything else
    """
    address, _, port = text.strip().rpartition(":")
    if not port.isascii() or not port.isdigit() or int(port) > 65535 or (":" in address and address[0] != "["):
        raise ConfigError(f"{what} = {text!r}: write [ADDRESS:]PORT, such as {PORT} or 0.0.0.0:{PORT}")
    host = address.strip("[]") or ADDRESS
    return ANY[0] if host in ("*", "0") else host, int(port)


def _answers(address: str, port: int) -> bool:
    """Whether a dashboard answers there. Any other server is read for two seconds and a few thousand bytes at most."""
    try:
        with socket.create_connection((address, port), _ANSWER_S) as connection:
            connection.sendall(b"GET /alive HTTP/1.0\r\n\r\n")
            return b'"instance"' in receive(connection, _ANSWER_BYTES, _ANSWER_S, b'"instance"')
    except (OSError, ValueError, OverflowError):
        return False
