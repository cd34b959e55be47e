"""`gr-ros2 registry`: check a registry CSV, or write one from the topics of a ROS graph or a bag."""

from __future__ import annotations

import csv
import io
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import click
from click.shell_completion import CompletionItem
from rich import box
from rich.console import Console
from rich.table import Table

from gr_ros2.cli.params import Completed, Number, OrAuto
from gr_ros2.core.errors import ConfigError
from gr_ros2.core.names import INFRASTRUCTURE, checked_namespace, first, topic_fault
from gr_ros2.middleware import MIDDLEWARE, Qos, TopicInfo, join_graph
from gr_ros2.middleware.adapt import settle
from gr_ros2.middleware.bag_files import bag_contents
from gr_ros2.middleware.services import ServiceGraph
from gr_ros2.observe.positions import humble_types
from gr_ros2.settings.config import DEFAULT_MIDDLEWARE, SendOptions
from gr_ros2.settings.fields import AUTO, Auto
from gr_ros2.settings.registry import MAX_TOPICS, Registry, Topic
from gr_ros2.settings.service_rows import OF_ACTION, ServiceRow, parts, rows_of

_NO_MESSAGES = {"srv": "a service", "action": "an action"}
"""Middle part of a type name other than ``msg``, and what has such types."""
_LATCHED = "durability"
_QOS_COLUMNS = ("reliability", _LATCHED, "depth")
_SHARED = [name for name, backend in MIDDLEWARE.own.items() if backend.scope == "shared"]


@click.command()
@click.argument("file", metavar="FILE")
def check(file: str) -> None:
    """Validate a registry CSV: print ids, names and types, and the digest by which two ends compare."""
    registry = Registry.from_csv(file)
    known = humble_types().fielddefs
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    table.add_column("id", justify="right")
    for heading in ("topic", "type", "definition", "options"):
        table.add_column(heading, overflow="fold")
    for topic in registry:
        definition = "Humble" if topic.type_name in known else "unknown"
        table.add_row(str(topic.topic_id), topic.name, topic.type_name, definition, _options(topic))
    Console().print(table)
    unknown = [topic.type_name for topic in registry if topic.type_name not in known]
    if unknown:
        print(f"no known definition: {', '.join(unknown)} (crosses as raw bytes; rclpy needs the package installed)")
    print(f"digest {registry.digest}")


_namespace = click.option(
    "--namespace", default="", metavar="NS", help="Only topics of this namespace, named relative to it."
)
_topics = click.option("--topics", default="", metavar="A,B,…", help="Only these topics, in this order.")
_out = click.option("--out", type=click.Path(dir_okay=False, path_type=Path), help="File to write; default: print it.")


class SharedGraph(Completed):
    """A middleware whose graph other processes can join. Those of other packages are looked up only when named."""

    name = "middleware"

    def convert(self, value: str, param: click.Parameter | None, ctx: click.Context | None) -> str:
        if value not in MIDDLEWARE or MIDDLEWARE[value].scope != "shared":
            self.fail(f"{value!r} has no graph that a robot could be on; take {', '.join(_SHARED)}", param, ctx)
        return value

    def candidates(self) -> Iterable[CompletionItem]:
        return map(CompletionItem, _SHARED)


def shared_graph(whose: str, auto: str = "ROS_DOMAIN_ID") -> Callable[[Any], Any]:
    """The options that name the graph of a robot: ``middleware`` and ``domain_id``.

    :param whose: help of the first
    :param auto: what that domain is, for the help of the second
    """

    def options(command: Any) -> Any:
        domain = click.option(
            "--domain-id",
            default=AUTO,
            type=OrAuto(click.IntRange(0, 232)),
            help=f"ROS domain; default auto: {auto}.",
        )
        kind: dict[str, Any] = {
            "default": DEFAULT_MIDDLEWARE,
            "show_default": True,
            "type": SharedGraph(),
            "metavar": "NAME",
        }
        return click.option("--middleware", help=whose, **kind)(domain(command))

    return options


@click.command("from-graph")
@_namespace
@_topics
@shared_graph(f"Whose graph: {', '.join(_SHARED)}.")
@click.option("--wait", default=3.0, show_default=True, type=Number(0, 600), help="Seconds to look around.")
@click.option("--services", is_flag=True, help="Services and actions too, for links of version 1.")
@_out
def from_graph(
    *,
    namespace: str,
    topics: str,
    middleware: str,
    domain_id: int | Auto,
    wait: float,
    services: bool,
    out: Path | None,
) -> None:
    """Write a registry from the topics that are published on the ROS graph."""
    with join_graph(middleware, domain_id=domain_id, node_name="gr_ros2") as graph:
        time.sleep(wait)  # discovery does not report when it is complete
        found = graph.discover()
        offered = rows_of(graph.discover_services()) if services and isinstance(graph, ServiceGraph) else []
    actions = {row.name for row in offered}
    left_out = {topic: why for topic, why in unfit(found).items() if topic.rpartition(OF_ACTION)[0] not in actions}
    _write(registry_csv(found, namespace, _names(topics), services=offered), left_out, out)


@click.command("from-bag")
@click.argument("bag", type=click.Path(path_type=Path))
@_namespace
@_topics
@_out
def from_bag(*, bag: Path, namespace: str, topics: str, out: Path | None) -> None:
    """Write a registry from the topics of BAG, a folder or a bare .mcap or .db3 file.

    Its QoS columns are what the publishers offered when the bag was recorded.
    """
    contents = bag_contents(bag)
    found = [topic.info for topic in contents.some().values()]
    _write(registry_csv(found, namespace, _names(topics), bag), {**contents.left_out, **unfit(found)}, out)
    for line in contents.differences:
        print(line, file=sys.stderr)


def unfit(found: Sequence[TopicInfo]) -> dict[str, str]:
    """Topics that a registry cannot have, by name, with the reason."""
    types: dict[str, list[str]] = {}
    for info in found:
        types.setdefault(info.topic, []).append(info.type_name)
    reasons = {}
    for topic, names in types.items():
        kind = names[0].split("/")[1] if names[0].count("/") == 2 else ""
        if len(names) > 1:
            reasons[topic] = f"it has several types, {' and '.join(sorted(names))}"
        elif kind in _NO_MESSAGES or "/_action/" in topic:
            owner = _NO_MESSAGES.get(kind, "an action")
            reasons[topic] = f"it belongs to {owner}, for which this registry has no row (docs/how-to/services.md)"
        elif kind != "msg":
            reasons[topic] = f"{names[0]!r} is no message type of ROS"
        elif fault := topic_fault(topic):
            reasons[topic] = f"ROS allows no such name, {fault}"
    return reasons


def registry_csv(
    found: Sequence[TopicInfo],
    namespace: str,
    wanted: Sequence[str] = (),
    bag: Path | None = None,
    services: Sequence[ServiceRow] = (),
) -> str:
    """The text of a registry CSV with header.

    :param found: topics of the graph or the bag; those without a publisher and :func:`unfit` ones are left out
    :param namespace: only topics below it, by their names relative to it; '' takes all
    :param wanted: only these names, in this order, with or without leading slash; [] takes all, sorted by name
    :param bag: the bag of the topics; the CSV then has columns with the QoS that their publishers offered. None: the
        topics are of the graph, which does not tell all of the QoS, and where subscriptions adapt; the CSV then has a
        column only for latched topics
    :param services: services and actions of the graph; those that ROS itself gives to nodes are left out
    :raises ConfigError: when nothing is left, a wanted topic is missing or unfit, the namespace is not valid in ROS, or
        more than 240 rows remain
    """
    try:
        checked_namespace(namespace)
    except ValueError as error:
        raise ConfigError(f"--namespace {namespace!r}: {error}") from error
    prefix = f"/{namespace.strip('/')}/" if namespace.strip("/") else "/"
    reasons = unfit(found)
    published = {
        info.topic.removeprefix(prefix): info
        for info in sorted(found, key=lambda info: info.topic)
        if info.publishers and info.topic.startswith(prefix) and info.topic not in (*INFRASTRUCTURE, *reasons)
    }
    offered = {
        name: row.kind
        for row in services
        if row.name.startswith(prefix)
        and not row.of_node
        and not topic_fault(row.name)
        and "/_" not in row.name
        and (name := row.name.removeprefix(prefix)) not in published
    }
    names = [name.lstrip("/").removeprefix(prefix[1:]) for name in wanted] or [*published, *offered]
    seen = f"published below {prefix} are {', '.join(first(published)) or 'no topics'}"
    for name in names:
        if why := reasons.get(f"{prefix}{name}"):
            raise ConfigError(f"topic {name!r} cannot be registered: {why}")
        if name not in published and name not in offered:
            raise ConfigError(f"topic {name!r} is not {f'in {bag}' if bag else 'on the graph'}; {seen}")
    if not names:
        remedy = f"choose another namespace of {bag}" if bag else "is the robot running, and in this ROS domain?"
        raise ConfigError(f"nothing to register: {seen}; {remedy}")
    count = sum(len(parts(name, offered.get(name, ""))) for name in names)
    if count > MAX_TOPICS:
        raise ConfigError(
            f"{count} topics, a registry has at most {MAX_TOPICS}; choose with --namespace or --topics; {seen}"
        )
    offers = {name: _offered(published[name].publishers) for name in names if name in published}
    columns: tuple[str, ...] = _QOS_COLUMNS
    if bag is None:
        offers = {
            name: {_LATCHED: "" if offer[_LATCHED] == "volatile" else offer[_LATCHED]} for name, offer in offers.items()
        }
        columns = (_LATCHED,) if any(offer[_LATCHED] for offer in offers.values()) else ()
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["topic", "type", *columns])
    for name in names:
        qos = [offers[name][column] if name in offers else "" for column in columns]
        writer.writerow([name, offered[name] if name in offered else published[name].type_name, *qos])
    return text.getvalue()


def _offered(publishers: Sequence[Qos]) -> dict[str, str]:
    """The QoS that all publishers of a topic offer, by column. The depth is the largest of theirs."""
    qos = settle(Qos(), publishers)
    depth = max(offer.depth for offer in publishers) if all(offer.depth for offer in publishers) else 0
    return {"reliability": str(qos.reliability), "durability": str(qos.durability), "depth": str(depth)}


def _names(text: str) -> list[str]:
    return [name.strip() for name in text.split(",") if name.strip()]


def _write(text: str, left_out: Mapping[str, str], out: Path | None) -> None:
    """Write a registry to its file or to the terminal. Topics that are left out are reported on stderr."""
    for line in first(f"{topic} is left out: {why}" for topic, why in left_out.items()):
        click.echo(f"gr-ros2: {line}", err=True)
    if out is None:
        print(text, end="")
        return
    try:
        out.write_text(text, encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{out}: cannot be written ({error.strerror})") from error
    print(f"{out}: {len(text.splitlines()) - 1} topics, digest {Registry.from_csv(out).digest}")


def _options(topic: Topic) -> str:
    default = SendOptions()
    changed = {item.name: getattr(topic.options, item.name) for item in fields(SendOptions)}
    return ", ".join(f"{key}={value}" for key, value in changed.items() if value != getattr(default, key))
