"""What a link does right now, as tables; `gr-ros2 status` and `gr-ros2 peers`, which ask a running link for it."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import click
from rich import box
from rich.console import Console, Group
from rich.live import Live
from rich.table import Table

from gr_ros2.cli.console import airtime_words
from gr_ros2.cli.console import console as make_console
from gr_ros2.cli.control_socket import SET, STATUS, request, running_programs
from gr_ros2.core.errors import ConfigError, RunError
from gr_ros2.link.clocks import ClockOffset
from gr_ros2.settings.files import parse_override

NO_LINK = "no link of yours runs; start one with gr-ros2 link"
_EVERY_S = 0.5

Stats = Mapping[str, Any]

pid_option = click.option("--pid", type=int, help="Process of the link, where several run.")
json_option = click.option("--json", "as_json", is_flag=True, help="One line of JSON instead of tables.")


@contextmanager
def live_tables(console: Console) -> Iterator[Callable[[Stats], None]]:
    """Shows :func:`tables` in place on a terminal."""
    with Live("", console=console, auto_refresh=False) as shows:
        yield lambda stats: shows.update(tables(stats), refresh=True)


def tables(stats: Stats) -> Group:
    """Who is heard, what crosses, and what the airtime is used for.

    :param stats: from :meth:`gr_ros2.radio.robot_link.RobotLink.stats`
    """
    return Group(
        _heading(stats),
        peer_table(stats["peers"]),
        _topic_table(stats),
        *_made(stats),
        *radio_words(stats),
        *(wish["words"] for wishes in ("wanted", "wants") for wish in stats["wishes"].get(wishes, ())),
        *_air(stats),
        *_troubles(stats),
    )


def radio_words(stats: Stats) -> list[str]:
    """What each of several radios does, in a line; one radio needs none."""
    lines = []
    for name, radio in stats.get("radios", {}).items():
        state = "carries" if radio["carries"] else "stands by" if radio["present"] else "gone"
        heard = ", ".join(f"robot {robot} {share:.0%}" for robot, share in radio["heard"].items())
        what = f"radio {name} ({radio['phy']['name']}, {radio['phy']['airtime_s'] * 1e3:.3g} ms a packet): "
        if radio["apart"]:
            lines.append(f"{what}{'' if radio['present'] else 'gone; '}carries only what names it")
        else:
            sent = f"{radio['sent']} packets and {radio['copied']} copies sent"
            lines.append(f"{what}{state}; {sent}; heard: {heard or 'nobody'}")
        if (bound := radio.get("bound")) and (bound["topics"] or radio["apart"]):
            lines.append(f"radio {name} alone: {bound_words(radio)}")
    return lines


def bound_words(radio: Mapping[str, Any]) -> str:
    """What goes over one of several radios alone, and whether it has a way."""
    bound = radio["bound"]
    mcs = f", sent with {radio['phy']['mcs']}" if "mcs" in radio["phy"] else ""
    words = f"{', '.join(bound['topics']) or 'no topic'}{mcs}; {bound['packets']} packets sent"
    words += f", {bound['waiting']} messages wait"
    if not radio["present"]:
        return f"{words}, until the device is back"
    return words if bound["heard"] else f"{words}; nobody is heard there, so nothing says that they arrive"


def _heading(stats: Stats) -> str:
    phy = stats["phy"]
    rate = f" at {phy['sample_rate']:,.0f} samples/s" if phy["sample_rate"] else ""
    mcs = f", {phy['mcs']}" if "mcs" in phy else ""
    where = f"{stats['front_end']['name']}, {phy['name']}{rate}{mcs}"
    return f"robot {stats['source']['src_id']} ({stats['name']}) on {where}, for {stats['uptime_s']:.0f} s"


def _table(*columns: str) -> Table:
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for column in columns:
        table.add_column(column, justify="left" if column in ("robot", "topic", "dropped", "state") else "right")
    return table


def peer_table(peers: list[Mapping[str, Any]]) -> Table | str:
    """The robots that were heard."""
    if not peers:
        return "nobody heard yet (gr-ros2 link --check says why)"
    table = _table("robot", "state", "heard ago", "SNR", "packets lost", "topics", "sealed", "clock")
    for peer in peers:
        clock = peer["clock"]
        table.add_row(
            str(peer["robot"]),
            peer_state(peer),
            in_seconds(peer["heard_s"]),
            "" if peer["snr_db"] is None else f"{peer['snr_db']:.1f} dB",
            f"{peer['lost']} ({peer['loss']:.1%} lately)",
            str(peer["topics"]),
            "yes" if peer["sealed"] else "no",
            "" if clock is None else f"{ClockOffset(**clock).words} ahead",
        )
    return table


def peer_state(peer: Mapping[str, Any]) -> str:
    """Whether a robot is heard, in a word or two."""
    if peer["doubled"]:
        return "two robots"
    if peer["silent"]:
        return "silent"
    return f"over {peer['over']}, hop {peer['hops']}" if peer["hops"] else "heard"


def _topic_table(stats: Stats) -> Table | str:
    table = _table("topic", "messages", "age", "latency", "waiting", "dropped")
    for name, topic in stats["source"]["topics"].items():
        lost = {**topic["refused"], "lost_on_graph": topic["lost_on_graph"], "unconfirmed": topic["unconfirmed"]}
        table.add_row(f"→ {name}", str(topic["sent"]), "", "", str(topic["queued"]), _reasons(lost))
    for name, topic in stats["sink"]["topics"].items():
        recent = topic["recent_latency_s"]
        latency = "" if recent is None else in_seconds(recent["p50"])
        age = "" if topic["age_s"] is None else in_seconds(topic["age_s"])
        table.add_row(f"← {name}", str(topic["delivered"]), age, latency, "", _reasons(topic["lost"]))
    return table if table.row_count else "no topics yet"


def _made(stats: Stats) -> list[str]:
    """What becomes of topics that are not sent as they are."""
    return [topic["frames"]["words"] for topic in stats["source"]["topics"].values() if topic["frames"]]


def _air(stats: Stats) -> list[str]:
    air = stats["source"]["air"]
    total = sum(air.values())
    shares = ", ".join(f"{kind} {count / total:.0%}" for kind, count in air.items()) if total else "nothing"
    packets = stats["packets"]
    limit = airtime_words(stats["airtime"])
    return [
        f"packets sent: {packets['out']} ({shares}), {packets['backlog']} wait; received: {stats['sink']['packets']}",
        *([limit] if limit else []),
    ]


def _troubles(stats: Stats) -> list[str]:
    sink, packets = stats["sink"], stats["packets"]
    lost = {
        **stats["front_end"]["lost"],
        **{f"refused: {reason}": count for reason, count in sink["rejected"].items()},
        "damaged": packets["damaged"],
        "not sent": packets["refused"],
        **{f"not sent: {reason}": count for reason, count in stats["airtime"]["refused"].items()},
        "not published": sink["publish_failed"],
    }
    words = _reasons(lost)
    return ([f"dropped: {words}"] if words else []) + [*stats.get("findings", ()), *stats["incomplete"]]


def _reasons(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in counts.items() if count)


def in_seconds(value: float) -> str:
    """A duration with its unit."""
    return f"{value:.1f} s" if abs(value) >= 1 else f"{value * 1e3:.0f} ms"


def find_link(pid: int | None) -> int:
    """The process of the running link.

    :param pid: None: the only one of this user
    :raises RunError: when none runs
    :raises ConfigError: when several run
    """
    if pid is not None:
        return pid
    running = running_programs()
    if not running:
        raise RunError(NO_LINK)
    if len(running) > 1:
        several = ", ".join(f"{pid} ({name})" for pid, name in running.items())
        raise ConfigError(f"several run: {several}; say which with --pid")
    return next(iter(running))


def status_of(pid: int) -> dict[str, Any]:
    """What a running link counts.

    :raises RunError: when it has ended, or is no link
    """
    found: dict[str, Any] = ask_link(pid, STATUS, True)
    return found


def ask_link(pid: int, question: str, value: Any) -> Any:
    """What a running link answers.

    :param question: such as ``STATUS``
    :raises RunError: when it has ended, refuses, or is no link
    """
    answer = request(pid, {question: value})
    if question not in answer:
        raise RunError(f"process {pid}: {answer.get('name', '?')} is no link")
    return answer[question]


def show_until(console: Console, look: Callable[[], Any], *, live: bool) -> None:
    """Show something once, or again and again until Ctrl-C."""
    if not live:
        console.print(look(), soft_wrap=True)
        return
    try:
        with Live(look(), console=console, auto_refresh=False, transient=False) as shown:
            while True:
                time.sleep(_EVERY_S)
                shown.update(look(), refresh=True)
    except KeyboardInterrupt:
        return


@click.command()
@click.option("--live", is_flag=True, help="Show it again and again until Ctrl-C.")
@pid_option
@json_option
def status(*, live: bool, pid: int | None, as_json: bool) -> None:
    """What a running link does: who is heard, each topic, what the air is used for, and what is dropped and why."""
    chosen = find_link(pid)
    if as_json:
        click.echo(json.dumps(status_of(chosen)))
        return
    show_until(make_console(), lambda: tables(status_of(chosen)), live=live)


@click.command()
@pid_option
@json_option
def peers(*, pid: int | None, as_json: bool) -> None:
    """The robots that a running link hears, the newest first."""
    found = status_of(find_link(pid))["peers"]
    if as_json:
        click.echo(json.dumps(found))
    else:
        make_console().print(peer_table(found), soft_wrap=True)


@click.command("set")
@click.argument("settings", nargs=-1, required=True, metavar="SETTING=VALUE...")
@pid_option
def set_live(*, settings: tuple[str, ...], pid: int | None) -> None:
    """Change settings of a running link, such as topics.goal.to=7: whom a topic is for.

    The file of the link stays as it is. What cannot change while a link runs is refused, and what can is named.
    """
    changes = [(".".join(keys), value) for keys, value in map(parse_override, settings)]
    for line in ask_link(find_link(pid), SET, changes):
        click.echo(line)
