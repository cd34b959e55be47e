"""`gr-ros2 top`: all links that run on this machine, side by side.

Invariants: each link is asked in a thread of its own, so that one that does not answer delays nothing. What a link says
is judged by ``gr.health`` alone, with that link's own limits.
"""

from __future__ import annotations

import json
import os
import select
import sys
import termios
import threading
import time
import tty
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, Literal

import click
from rich import box
from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from gr_ros2.cli.console import console as make_console
from gr_ros2.cli.control_socket import STATUS, sockets
from gr_ros2.cli.status import NO_LINK, Stats, ask_link, in_seconds, json_option, peer_state
from gr_ros2.core.errors import RunError, shortened
from gr_ros2.core.watch import Watch
from gr_ros2.gr.health import LinkHealth
from gr_ros2.settings.config import DiagnosticsConfig, build
from gr_ros2.wire import BROADCAST

_EVERY_S = 1.0
"""s between two looks at a link."""
_POLL_S = 0.05
_LEAVE = "q"
_LATE_S = 3.0
"""s without an answer after which a link counts as one that does not answer."""


class Watched:
    """A program with a control socket, which is asked again and again until ``gone`` is set or it is closed."""

    def __init__(self, pid: int) -> None:
        self._pid, self._answered_at, self._silence = pid, time.monotonic(), Watch(2 * _EVERY_S)
        self._health: LinkHealth | None = None
        self._row: dict[str, Any] | None = None
        """What it has said; None while it is not known to be a link."""
        self._looks = 0
        self._refuses = False
        self.gone = threading.Event()
        self._thread = threading.Thread(target=self._watch, name=f"gr-ros2-top-{pid}", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Ask no more. Who does not answer is not waited for."""
        self.gone.set()
        self._thread.join(_POLL_S)

    def row(self) -> dict[str, Any] | None:
        """Its row of the table; None while nothing is known, and for a run."""
        silent_s = self._silent_s()
        late = silent_s > _LATE_S
        if self._row is None and (self._refuses or not late):
            return None
        row = self._row or {"pid": self._pid, "name": f"process {self._pid}", "warnings": []}
        silence = [f"has not answered for {silent_s:.0f} s"] if late else []
        return {**row, "answers": not late, "warnings": [*silence, *row["warnings"]]}

    @property
    def settled(self) -> bool:
        """Whether waiting longer brings no more than the next look."""
        return self._looks > 1 or self._refuses or self._silent_s() > _LATE_S

    def _silent_s(self) -> float:
        """s since its last answer, as far as this program has run itself."""
        now = time.monotonic()
        return self._silence.age(now - self._answered_at, now)

    def _watch(self) -> None:
        while not self.gone.is_set():
            try:
                stats = ask_link(self._pid, STATUS, True)
                self._row = self._judged(stats)
            except RunError as error:
                self._refuses = error.__cause__ is None  # a run, or a link that begins; else it does not answer
            except Exception as error:  # noqa: BLE001 - it is another program, of whatever release
                self._row = {
                    "pid": self._pid,
                    "name": f"process {self._pid}",
                    "warnings": [shortened(f"its answer is not understood ({error!r}); is it of another release?")],
                }
                self._answered()
            else:
                self._answered()
            self.gone.wait(_EVERY_S)

    def _answered(self) -> None:
        self._answered_at, self._looks, self._refuses = time.monotonic(), self._looks + 1, False

    def _judged(self, stats: Stats) -> dict[str, Any]:
        if self._health is None:
            limits = build(DiagnosticsConfig, stats.get("limits", {}))
            self._health = LinkHealth(replace(limits, period_s=_EVERY_S), stats["name"])
        parts = self._health.judge(stats, time.monotonic())
        recent = self._health.recent()._asdict()
        ages = {
            name: topic["age_s"]
            for name, topic in stats["sink"]["topics"].items()
            if topic["age_s"] is not None and not topic.get("latched")
        }
        oldest = max(ages, key=ages.__getitem__, default=None)
        return {
            "pid": self._pid,
            "name": str(stats["name"]),
            "robot": int(stats["source"]["src_id"]),
            "front_end": stats["front_end"]["name"],
            "phy": stats["phy"]["name"],
            "peers": stats["peers"],
            **(recent if self._looks else dict.fromkeys(recent)),
            "oldest_topic": oldest,
            "age_s": None if oldest is None else ages[oldest],
            "warnings": [
                *(f"{part.name.removeprefix(stats['name'] + ': ')}: {part.message}" for part in parts if part.level),
                *stats.get("findings", ()),
                *stats["incomplete"],
            ],
        }


class Links:
    """All links that this user may ask, from when it is entered until it is left."""

    def __init__(self) -> None:
        self._watched: dict[int, Watched] = {}

    def __enter__(self) -> Links:
        return self

    def __exit__(self, *_: object) -> None:
        for watched in self._watched.values():
            watched.gone.set()
        for watched in self._watched.values():
            watched.close()

    def look(self) -> list[dict[str, Any]]:
        """Their rows, by robot and name: links that have begun since are asked from now on, those that have ended are
        forgotten."""
        running = sockets()
        for pid in self._watched.keys() - running.keys():
            self._watched.pop(pid).gone.set()
        for pid in running.keys() - self._watched.keys():
            self._watched[pid] = Watched(pid)
        rows = [row for watched in self._watched.values() if (row := watched.row()) is not None]
        return sorted(rows, key=lambda row: (row.get("robot", BROADCAST), row["name"], row["pid"]))

    @property
    def settled(self) -> bool:
        """Whether each is known as well as two looks tell."""
        return all(watched.settled for watched in self._watched.values())


def link_table(rows: Sequence[Mapping[str, Any]]) -> Group | str:
    """All links, and what is wrong with each."""
    if not rows:
        return NO_LINK
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for column, justify in _COLUMNS.items():
        table.add_column(column, justify=justify)
    for row in rows:
        cells = _cells(row) if "robot" in row else ()
        style = "" if row["answers"] and not row["warnings"] else "bold" if row["answers"] else "dim"
        table.add_row(str(row["pid"]), *map(_plain, (row["name"], *cells)), style=style)
    return Group(table, *(_plain(f"{row['name']}: {line}") for row in rows for line in row["warnings"]))


def _plain(words: str) -> Text:
    """What another program says, which is no markup and moves no cursor."""
    return Text(shortened(words))


_COLUMNS: Mapping[str, Literal["left", "right"]] = {
    "pid": "right",
    "link": "left",
    "robot": "right",
    "on": "left",
    "hears": "left",
    "out/s": "right",
    "in/s": "right",
    "air": "right",
    "PDR": "right",
    "oldest topic": "left",
}


def _cells(row: Mapping[str, Any]) -> Iterator[str]:
    yield str(row["robot"])
    yield f"{row['front_end']}, {row['phy']}"
    yield ", ".join(_heard(peer) for peer in row["peers"]) or "nobody"
    for name, form in (("sent", ".1f"), ("received", ".1f"), ("air", ".1%"), ("delivered", ".1%")):
        yield "" if row[name] is None else format(row[name], form)
    yield "" if row["oldest_topic"] is None else f"{row['oldest_topic']} {in_seconds(row['age_s'])}"


def _heard(peer: Mapping[str, Any]) -> str:
    state = peer_state(peer)
    words = [str(peer["robot"]), *(["" if state == "heard" else f"({state})"])]
    if peer["snr_db"] is not None:
        words.append(f"{peer['snr_db']:.1f} dB")
    return " ".join(word for word in words if word)


@contextmanager
def _keys() -> Iterator[Callable[[float], str]]:
    """A function that waits for a key for so many s and returns it, or ''; where no keyboard is, it only waits."""
    if not sys.stdin.isatty():

        def wait(timeout_s: float) -> str:
            time.sleep(timeout_s)
            return ""

        yield wait
        return
    keyboard = sys.stdin.fileno()
    before = termios.tcgetattr(keyboard)

    def key(timeout_s: float) -> str:
        if not select.select([keyboard], [], [], timeout_s)[0]:
            return ""
        return os.read(keyboard, 1).decode(errors="replace") or _LEAVE  # the terminal is closed

    try:
        tty.setcbreak(keyboard)
        yield key
    finally:
        termios.tcsetattr(keyboard, termios.TCSADRAIN, before)


@click.command()
@click.option("--once", is_flag=True, help="Show it once. So it is where the output is no terminal.")
@json_option
def top(*, once: bool, as_json: bool) -> None:
    """All links that run on this machine: whom each hears, packets/s, share of the air, and what is wrong.

    Key q ends it. Root sees the links of all users, and services. Of runs there is gr-ros2 dashboard.
    """
    console = make_console()
    with Links() as links:
        links.look()
        while not links.settled:
            time.sleep(_POLL_S)
            links.look()
        rows = links.look()
        if not rows:
            raise RunError(NO_LINK)
        if as_json:
            click.echo(json.dumps(rows))
        elif once or not console.is_terminal:
            console.print(link_table(rows), soft_wrap=True)
        else:
            _show(console, links, rows)


def _show(console: Console, links: Links, rows: Sequence[Mapping[str, Any]]) -> None:
    """Show them again and again, until key q or Ctrl-C."""
    with _keys() as key, Live(link_table(rows), console=console, auto_refresh=False, screen=True) as shown:
        try:
            while key(_EVERY_S) != _LEAVE:
                shown.update(link_table(links.look()), refresh=True)
        except KeyboardInterrupt:
            return
