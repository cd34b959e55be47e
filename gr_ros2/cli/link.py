"""`gr-ros2 link`: one robot's end of a link, until Ctrl-C."""

from __future__ import annotations

import logging
import signal
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, nullcontext
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import click
from pydantic import Field
from pydantic.dataclasses import dataclass

from gr_ros2.calls.wish_frames import MOST_RATE
from gr_ros2.cli.console import LOG_S, Lines, airtime_words, lines
from gr_ros2.cli.control_socket import LISTEN, LISTEN_S, MEASURE, OFFERS, PING, SET, STATUS, WANT
from gr_ros2.cli.dashboard import audience, dashboard_option, foxglove_option, foxglove_server
from gr_ros2.cli.ending import FAILED
from gr_ros2.cli.params import BackendName, Number, set_option
from gr_ros2.cli.recording import bag_option, pcap_option, recording
from gr_ros2.core.backends import uninterrupted
from gr_ros2.core.errors import ConfigError, RadioError
from gr_ros2.core.guard import Guard
from gr_ros2.core.systemd import notify
from gr_ros2.link.clocks import ClockOffset
from gr_ros2.middleware import MIDDLEWARE
from gr_ros2.observe.bag import OutputBag
from gr_ros2.observe.capture import PacketCapture
from gr_ros2.radio import FRONT_ENDS, PRESETS
from gr_ros2.radio.config import LinkConfig, link_from, load_link
from gr_ros2.radio.one_line import FLAGS, one_line
from gr_ros2.settings.config import DEFAULT_MIDDLEWARE, STRICT, RobotId, build
from gr_ros2.settings.files import portable_registry, settled
from gr_ros2.settings.yaml_text import yaml_text
from gr_ros2.wire import BROADCAST

if TYPE_CHECKING:
    from rich.console import Console

    from gr_ros2.observe.observers import LiveRun
    from gr_ros2.radio.robot_link import RobotLink

_log = logging.getLogger(__name__)
_SHOW_S = 0.5


def _flag(name: str, **how: Any) -> Callable[[Any], Any]:
    return click.option(f"--{name}", help=f"Without CONFIG: {FLAGS[name].meaning}.", **how)


@click.command()
@click.argument("config", type=click.Path(path_type=Path), required=False)
@click.option("--robot", type=click.IntRange(0, BROADCAST - 1), help="Without CONFIG: number of this robot.")
@click.option("--radio", type=BackendName(FRONT_ENDS, PRESETS), help="Without CONFIG: what carries the packets.")
@_flag("listen", metavar="ADDRESS")
@_flag("peer", metavar="ADDRESS", multiple=True)
@_flag("device", metavar="ARGS")
@_flag("frequency", type=Number(), metavar="HZ")
@_flag("frequency-rx", type=Number(), metavar="HZ")
@click.option("--registry", metavar="CSV", help="Without CONFIG: a file of topics to send; default: --topics auto.")
@click.option(
    "--topics", metavar="NAMES", help="Without CONFIG: topics to send, 'auto', 'auto, -camera/*', 'odom map'."
)
@click.option("--middleware", type=BackendName(MIDDLEWARE), help=f"Joins the ROS graph; default: {DEFAULT_MIDDLEWARE}.")
@click.option("--save", type=click.Path(dir_okay=False, path_type=Path), help="Without CONFIG: write it for next time.")
@click.option("--duration", type=Number(min=0, min_open=True), help="Seconds to run; default until Ctrl-C.")
@click.option("--transmit/--listen-only", default=None, help="A radio may send here, or only receives.")
@click.option("--open", "is_open", is_flag=True, help="A radio may send without a key, for anybody to read and forge.")
@click.option(
    "--check", "checks", is_flag=True, help="Say what this end and the others have, and what does not match; then end."
)
@click.option(
    "--against", type=click.Path(path_type=Path), metavar="FILE", help="With --check: the other end's YAML file, too."
)
@set_option(LinkConfig)
@dashboard_option
@foxglove_option
@pcap_option
@bag_option
def link(
    *,
    config: Path | None,
    robot: int | None,
    radio: str | None,
    registry: str | None,
    topics: str | None,
    middleware: str | None,
    save: Path | None,
    duration: float | None,
    transmit: bool | None,
    is_open: bool,
    checks: bool,
    against: Path | None,
    overrides: tuple[str, ...],
    dashboard: str | None,
    foxglove: str | None,
    pcap: Path | None,
    bag: Path | None,
    **flags: Any,
) -> int:
    """Run this robot's end of a link: its ROS topics to the air, and what is received to its ROS graph.

    The YAML file CONFIG describes the link. Without it, --robot and --radio do. The signal SIGUSR1 stops sending at
    once, SIGUSR2 begins again.
    """
    if middleware is not None:
        overrides = (f"graph.middleware={middleware}", *overrides)
    if transmit is not None:
        overrides = (f"transmit={str(transmit).lower()}", *overrides)
    if is_open:
        overrides = ("open=true", *overrides)
    given = {name.replace("_", "-"): value for name, value in flags.items() if value not in (None, ())}
    if config is not None:
        unused = [
            f"--{name}"
            for name, value in {"robot": robot, "radio": radio, "registry": registry, "topics": topics}.items()
            if value is not None
        ]
        unused += ["--save"] if save is not None else []
        if unused or given:
            named = ", ".join([*unused, *(f"--{name}" for name in given)])
            raise click.UsageError(f"{named}: {config} says what the link is; change its settings with --set")
        settings = load_link(config, overrides)
    elif robot is None or radio is None:
        raise click.UsageError("give a YAML file, or --robot and --radio")
    else:
        with uninterrupted():  # GNU Radio may be loaded
            values = one_line(robot, radio, registry, given, topics)
        settings = _in_one_line(values, overrides, save)
    if checks:
        from gr_ros2.cli.ping import check

        return check(settings, duration, against)
    if against is not None:
        raise click.UsageError("--against needs --check")
    # These load GNU Radio, which takes time. A wrong setting is reported before that.
    with uninterrupted():
        from gr_ros2.observe.observers import RunObservers
        from gr_ros2.radio.robot_link import RobotLink

    console = lines()
    answers: dict[str, Callable[[Any], Any]] = {}
    with ExitStack() as stack:
        clients = stack.enter_context(audience(dashboard, console, settings.name, answers=answers))
        captures = stack.enter_context(recording(PacketCapture, pcap))
        bags = stack.enter_context(recording(OutputBag, bag))
        viewers = stack.enter_context(foxglove_server(foxglove, console))
        run_observers = RunObservers([clients, *captures, *bags, *viewers], threaded=True)
        stack.callback(run_observers.run_ended, None)
        running = RobotLink(settings, observer=run_observers, instrumented=True)
        stack.callback(running.stop)
        for number, on in ((signal.SIGUSR1, False), (signal.SIGUSR2, True)):
            signal.signal(number, lambda *_, on=on: _switch(running, on))
        try:
            run_observers.run_started(_live(running))  # first: they pass over what comes before it
            running.start()
            answers |= _answers(running)
            _show(console, running, duration)
        except KeyboardInterrupt:
            pass  # the normal end of a link
        stats = running.stats()
        stack.close()
        console.print(status_line(stats), soft_wrap=True)
        missing = [*running.incomplete(), *(line for each in bags for line in each.incomplete())]
        for line in missing:
            console.print(line, soft_wrap=True)
        return FAILED if missing else 0


@dataclass(frozen=True, kw_only=True, config=STRICT)
class _Asked:
    """Which robot is asked, and whether earlier questions are forgotten."""

    robot: RobotId
    anew: bool = False


@dataclass(frozen=True, kw_only=True, config=STRICT)
class _Wish:
    """What is done about a topic of another robot."""

    robot: RobotId
    topic: str
    how: Literal["want", "give_up", "look"]
    rate: Annotated[float, Field(ge=0, le=MOST_RATE, allow_inf_nan=False)] = 0.0
    for_s: Annotated[float, Field(ge=1, allow_inf_nan=False)] = 60.0


@dataclass(frozen=True, kw_only=True, config=STRICT)
class _Changes:
    """Settings to change, each a name and a value."""

    changes: list[tuple[str, Any]]


@dataclass(frozen=True, kw_only=True, config=STRICT)
class _Measure:
    """The robot the link to which is measured, and s for each direction; without a robot, what has come of it."""

    robot: RobotId | None = None
    for_s: int = 10


@dataclass(frozen=True, kw_only=True, config=STRICT)
class _Listen:
    """s for which the link is silent and listens; without, what has come of it."""

    for_s: Annotated[float, Field(gt=0, le=LISTEN_S, allow_inf_nan=False)] | None = None


def _answers(running: RobotLink) -> dict[str, Callable[[Any], Any]]:
    """What clients may ask a running link, by the names of :mod:`gr_ros2.cli.control_socket`."""
    from gr_ros2.radio.live_settings import LiveSettings

    live = LiveSettings(running.source, running.sink)

    def ping(asks: Any) -> dict[str, Any]:
        asked = build(_Asked, asks, PING)
        return running.ping(asked.robot, anew=asked.anew)

    def change(asks: Any) -> list[str]:
        return [live.change(name, value) for name, value in build(_Changes, {"changes": asks}, SET).changes]

    def offers(asks: Any) -> dict[str, Any]:
        asked = build(_Asked, asks, OFFERS)
        return running.wishes.offers(asked.robot, anew=asked.anew)

    def want(asks: Any) -> dict[str, Any]:
        wish = build(_Wish, asks, WANT)
        wishes = running.wishes
        if wish.how == "want":
            wishes.want(wish.robot, wish.topic, wish.rate, wish.for_s)
        elif wish.how == "give_up":
            wishes.give_up(wish.robot, wish.topic)
        return wishes.wish(wish.robot, wish.topic)

    def measure(asks: Any) -> dict[str, Any]:
        asked = build(_Measure, asks, MEASURE)
        if asked.robot is not None:
            running.throughput.measure(asked.robot, asked.for_s)
        return running.throughput.look()

    def listen(asks: Any) -> dict[str, Any]:
        asked = build(_Listen, asks, LISTEN)
        if asked.for_s is not None:
            running.listening.measure(asked.for_s)
        return running.listening.look()

    return {
        STATUS: lambda _: {
            **running.stats(),
            "findings": running.findings.lines(),
            "limits": asdict(running.config.diagnostics),
            "graph": {"domain_id": running.config.graph.domain_id, "namespace": running.config.namespace},
        },
        PING: ping,
        SET: change,
        OFFERS: offers,
        WANT: want,
        MEASURE: measure,
        LISTEN: listen,
    }


def _switch(running: RobotLink, on: bool) -> None:
    try:
        running.transmit(on=on)
    except ConfigError as error:  # a signal ends no link
        _log.warning("%s", error)


def _in_one_line(values: Mapping[str, Any], overrides: Sequence[str], save: Path | None) -> LinkConfig:
    """Make the settings of a link, print them as YAML, and write them to ``save``."""
    values = settled(values, Path(), overrides)
    settings = link_from(values, values["name"])
    text = yaml_text({**values, **({"registry": portable_registry(settings.registry)} if settings.registry else {})})
    where = "a YAML file (--save FILE writes it)" if save is None else save
    click.echo(f"# The same link as {where}:\n{text}")
    if save is not None:
        try:
            save.write_text(text, encoding="utf-8")
        except OSError as error:
            raise ConfigError(f"--save {save}: cannot be written ({error.strerror})") from error
    return settings


def _live(running: RobotLink) -> LiveRun:
    """The link as observers see it. They see only this end, so they have no fates."""
    from gr_ros2.observe.observers import LiveRun

    source = running.source
    return LiveRun(
        name=running.config.name,
        duration_s=0.0,
        packet_len=running.config.packet_len,
        registry=running.registry,
        topics={(source.src_id, topic.topic_id): name for name, topic in source.subscriptions.subscribed.items()},
        sources={source.src_id: source},
        links=(running.radio,),
        fates=None,
        airtime=running.phy.airtime if running.phy.has_airtime else None,
        received_as=running.sink.outputs.heard.name_of,
        announced=running.announced,
        alarms=running.findings.alarms,
        clocks=running.clocks,
        wishes=running.wishes if running.calls is not None else None,
        calls=running if running.calls is not None else None,
        wants_key=partial(_key_frame, running),
        hears_always=running.phy.has_samples and running.front_end.hears_always,
    )


def _key_frame(running: RobotLink, src_id: int, topic_id: int) -> None:
    live, topic_id = running.end_of(topic_id)
    with live.lock:
        frames = live.endpoint.frames
        if frames is not None and src_id == running.source.src_id:
            frames.watched(topic_id)
        elif frames is not None:
            frames.lost(src_id, topic_id)
        live.look()
        live.wake()


def _opening(running: RobotLink) -> str:
    radios = " and ".join(_on(one) for one in running.radios)
    return f"robot {running.source.src_id} on {radios}; Ctrl-C ends it"


def _on(one: Any) -> str:
    phy, front_end = one.phy, one.front_end
    rate = f" at {phy.sample_rate:,.0f} samples/s" if phy.has_samples else ""
    every = f", one packet per {front_end.airtime() * 1e3:.3g} ms" if front_end.airtime() else ""
    runs_on = f", runs on {phy.runs_on()}" if phy.runs_on() else ""
    options = one.own.front_end_options
    on_air = f", sends {front_end.on_air(options)}" if front_end.asks(options) else ""
    on_air = on_air if one.sends else ", only receives"
    return f"{one.name}: {phy.name}{rate}{every}{on_air}{runs_on}"


def _show(console: Console | Lines, running: RobotLink, duration: float | None) -> None:
    """Print what runs and what it waits for, with a live table, or plain lines where there is no terminal,
    until the time is over or the link has finished."""
    from gr_ros2.radio.waiting import NewFindings, Waiting

    guarded, say = Guard("status line"), partial(console.print, soft_wrap=True)  # the output may be on a full disk
    guarded(say, _opening(running))
    if running.config.remark:
        guarded(say, running.config.remark)
    notify("READY=1")
    end = float("inf") if duration is None else time.monotonic() + duration
    waiting = Waiting(running.source)
    with _tables(console) as show:
        shown = time.monotonic()
        findings = NewFindings(running.findings.lines)
        while (now := time.monotonic()) < end and not running.finished:
            time.sleep(min(_SHOW_S, end - now))
            _watch(running)
            if (waits_for := waiting.look()) is not None:
                guarded(say, waits_for)
            for line in findings.new(now):
                guarded(say, line)
            stats, due = running.stats(), time.monotonic() - shown >= LOG_S
            if due:
                shown = time.monotonic()
                notify(f"STATUS={status_line(stats)}")
            if show is not None:
                guarded(show, stats)
            elif due:
                guarded(say, status_line(stats))


def _tables(console: Console | Lines) -> AbstractContextManager[Callable[[Mapping[str, Any]], None] | None]:
    """What shows a link on a terminal; None where there is none."""
    if isinstance(console, Lines):
        return nullcontext()
    from gr_ros2.cli.status import live_tables

    return live_tables(console)


def _watch(running: RobotLink) -> None:
    """Check the link, and tell systemd that it goes on, or what does not."""
    try:
        running.check()
    except RadioError as error:
        notify(f"STATUS={error}")
        raise
    notify("WATCHDOG=1")


def status_line(stats: Mapping[str, Any]) -> str:
    """The traffic of a link in one line, from :meth:`RobotLink.stats`."""
    source, sink, packets = stats["source"], stats["sink"], stats["packets"]
    taken = sum(topic["submitted"] for topic in source["topics"].values())
    given = sum(topic["delivered"] for topic in sink["topics"].values())
    missing = source["unmatched"]
    sent = f"sent {taken} messages in {packets['out']} packets"
    if missing and not taken:
        sent = f"nothing sent, no publisher on {missing[0]}" + (f" and {len(missing) - 1} more" if missing[1:] else "")
    received = f"received {given} messages in {sink['packets']} packets" if sink["packets"] else "nobody heard"
    parts = [f"{stats['uptime_s']:.0f} s", sent, received]
    if airtime := airtime_words(stats["airtime"]):
        parts.append(airtime)
    if sink["packet_loss_est"]:
        parts.append(f"packets lost: about {sink['packet_loss_est']}")
    if stats["phy"]["snr_db"] is not None:
        parts.append(f"SNR {stats['phy']['snr_db']:.1f} dB")
    parts += [
        f"clock of robot {peer['robot']} {ClockOffset(**peer['clock']).words} ahead"
        for peer in stats["peers"]
        if peer["clock"] is not None
    ]
    parts += [f"{name} is {t['type']} now" for name, t in source["topics"].items() if t["types"] > 1]
    if lost := sum(topic["lost_on_graph"] for topic in source["topics"].values()):
        parts.append(f"{lost} messages lost on the ROS graph before they were sent")
    if sink["publish_failed"]:
        parts.append(f"{sink['publish_failed']} messages not published")
    troubles = {**stats["front_end"]["lost"], "refused": packets["refused"], "damaged": packets["damaged"]}
    parts += [f"{count} {name.replace('_', ' ')}" for name, count in troubles.items() if count]
    return "; ".join(parts)
