"""`gr-ros2 ping`, and `gr-ros2 link --check`: whether two ends understand each other, and if not, why."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from rich.live import Live

from gr_ros2.cli.console import LOG_S
from gr_ros2.cli.console import console as make_console
from gr_ros2.cli.control_socket import PING
from gr_ros2.cli.ending import FAILED
from gr_ros2.cli.params import MOST_S, Number, set_option
from gr_ros2.cli.status import ask_link, find_link, json_option, pid_option
from gr_ros2.core.backends import uninterrupted
from gr_ros2.core.watch import wait_until
from gr_ros2.radio.config import LinkConfig, load_link
from gr_ros2.settings.config import ClockConfig, DiagnosticsConfig
from gr_ros2.wire import BROADCAST

if TYPE_CHECKING:
    from collections.abc import Iterator

    from gr_ros2.radio.robot_link import RobotLink

CHECK_S = 15.0
"""s after which a check ends, if it is not told otherwise."""
_CHECK_PINGS, _CHECK_EVERY_S = 10, 0.3

Ask = Callable[[bool], Mapping[str, Any]]
"""Asks the robot, anew or not; returns what has come of all questions so far."""


def without_topics(settings: LinkConfig) -> LinkConfig:
    """The same link, with no topic and on no ROS graph."""
    return replace(
        settings,
        registry="",
        record="",
        topics={},
        graph=replace(settings.graph, middleware="memory"),
        clock=ClockConfig(),
        diagnostics=DiagnosticsConfig(period_s=0.0),
    )


@contextmanager
def opened(settings: LinkConfig, *, instrumented: bool = False) -> Iterator[RobotLink]:
    """A link that runs without topics.

    :param instrumented: see :class:`RobotLink`
    """
    with uninterrupted():
        from gr_ros2.radio.robot_link import RobotLink

    link = RobotLink(without_topics(settings), instrumented=instrumented)
    try:
        link.start()
        yield link
    finally:
        link.stop()


@click.command()
@click.argument("robot", type=click.IntRange(0, BROADCAST - 1))
@click.argument("config", type=click.Path(path_type=Path), required=False)
@click.option("--count", type=click.IntRange(1), help="Questions to ask; default until Ctrl-C, with --json 10.")
@click.option(
    "--interval", type=Number(0.1, MOST_S), default=1.0, show_default=True, help="Seconds from one to the next."
)
@pid_option
@json_option
@set_option(LinkConfig)
def ping(
    *,
    robot: int,
    config: Path | None,
    count: int | None,
    interval: float,
    pid: int | None,
    as_json: bool,
    overrides: tuple[str, ...],
) -> int:
    """Ask ROBOT over the link: round trip, loss in each direction, SNR at both ends, rate, clocks.

    A running link asks. With the YAML file CONFIG, a link without topics is started for it.
    """
    if count is None and as_json:
        count = 10
    if config is not None:
        with opened(load_link(config, overrides)) as link:
            return _ping(lambda anew: link.ping(robot, anew=anew), robot, count, interval, as_json=as_json)
    if overrides:
        raise click.UsageError("--set needs CONFIG; the settings of a running link are its own")
    chosen = find_link(pid)

    def ask(anew: bool) -> Mapping[str, Any]:
        told: Mapping[str, Any] = ask_link(chosen, PING, {"robot": robot, "anew": anew})
        return told

    return _ping(ask, robot, count, interval, as_json=as_json)


def _ping(ask: Ask, robot: int, count: int | None, interval: float, *, as_json: bool) -> int:
    from gr_ros2.radio.findings import in_words

    console = make_console()
    told: Mapping[str, Any] = {}
    asked, logged = 0, time.monotonic()
    try:
        shows = console.is_terminal and not as_json
        with Live("", console=console, auto_refresh=False) if shows else nullcontext() as live:
            while count is None or asked < count:
                told = ask(not asked)
                asked += 1
                line = f"robot {robot}: {in_words(told)}"
                if isinstance(live, Live):
                    live.update(line, refresh=True)
                elif not as_json and time.monotonic() - logged >= LOG_S:
                    logged = time.monotonic()
                    console.print(line, soft_wrap=True)
                time.sleep(interval)
            told = ask(False)  # the answer to the last question has come by now; this one's is not waited for
    except KeyboardInterrupt:
        pass
    told = told and {**told, "asked": max(asked, told["asked"])}  # the link may ask too
    if as_json:
        click.echo(json.dumps(told or {"asked": asked}))
    elif told:
        console.print(f"robot {robot}: {in_words(told)}", soft_wrap=True)
    return 0 if told.get("answered") else FAILED


def check(settings: LinkConfig, duration: float | None, against: Path | None = None) -> int:
    """Print what this end has, what the others have, and what does not match; returns the exit status.

    :param duration: s; the check ends before it when every robot heard has answered
    :param against: YAML file of the other end, which is compared too, whether or not that end is heard
    """
    from gr_ros2.radio.findings import about, compared, differences, heard_nobody, in_words

    console = make_console()
    apart = [] if against is None else compared(settings, load_link(against))
    if against is not None:
        for line in apart:
            console.print(f"{against} does not match: {line}", soft_wrap=True)
        if not apart:
            console.print(f"{against} matches", soft_wrap=True)
    with opened(settings) as link:
        own = about(settings, [one.phy for one in link.radios])
        key = f"{own['key']:08x} (seal {settings.seal})" if settings.key else "none"
        console.print(
            f"this end: robot {link.source.src_id}, gr-ros2 {own['text']}, front end {link.front_end.name}, "
            f"packet_len {own['packet_len']}, phy settings {own['phy']:08x}, key {key}",
            soft_wrap=True,
        )
        told: dict[int, Mapping[str, Any]] = {}

        def answered() -> bool:
            link.check()
            for peer in link.stats()["peers"]:
                told[peer["robot"]] = link.ping(peer["robot"])
            return _answered(told)

        wait_until(answered, CHECK_S if duration is None else duration, look_s=_CHECK_EVERY_S)
        stats = link.stats()
    if not told:
        console.print("no other end is heard:")
        for line in heard_nobody(stats):
            console.print(f"  {line}", soft_wrap=True)
        return FAILED
    wrong = 0
    for robot, peer in sorted(told.items()):
        other = peer["about"]
        said = "has not said what it is"
        if other is not None:
            said = (
                f"gr-ros2 {other['text']}, packet_len {other['packet_len']}, phy settings {other['phy']:08x}, "
                f"key {format(other['key'], '08x') if other['key'] else 'none'}"
            )
        console.print(f"robot {robot}: {said}", soft_wrap=True)
        console.print(f"  {in_words(peer)}", soft_wrap=True)
        found = [] if other is None else differences(own, other)
        if not peer["answered"]:
            found += ["it is heard, and does not answer: it does not hear this end, or sends nothing"]
            found += [line for line in heard_nobody(stats) if not line.startswith("nothing")]
        for line in found:
            console.print(f"  does not match: {line}", soft_wrap=True)
        wrong += bool(found)
        if not found:
            console.print("  both ends match")
    return FAILED if wrong or apart else 0


def _answered(told: Mapping[int, Mapping[str, Any]]) -> bool:
    return bool(told) and all(peer["answered"] >= _CHECK_PINGS and peer["about"] for peer in told.values())
