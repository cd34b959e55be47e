"""`gr-ros2 registry`: check a registry CSV, or write one from the topics on the ROS graph."""

from __future__ import annotations

import csv
import io
import time
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path

import click
from rich import box
from rich.console import Console
from rich.table import Table

from gr_ros2.config import TopicOptions
from gr_ros2.errors import ConfigError
from gr_ros2.middleware import MIDDLEWARE, Middleware, TopicInfo
from gr_ros2.record.positions import humble_types
from gr_ros2.registry import MAX_TOPICS, Registry, Topic

_INFRASTRUCTURE = ("/rosout", "/parameter_events")
"""Topics every ROS node has, which nobody wants on a radio by accident."""

_GRAPHS = [name for name in MIDDLEWARE if name in ("dds", "rclpy")]
"""Back-ends that join a live ROS graph."""


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


@click.command("from-graph")
@click.option("--namespace", default="", metavar="NS", help="Only topics of this namespace, named relative to it.")
@click.option("--topics", default="", metavar="A,B,…", help="Only these topics, in this order.")
@click.option("--middleware", default="dds", show_default=True, type=click.Choice(_GRAPHS))
@click.option("--domain-id", default=-1, type=click.IntRange(-1, 232), help="DDS domain; -1 takes ROS_DOMAIN_ID.")
@click.option("--wait", default=3.0, show_default=True, type=click.FloatRange(0, 600), help="Seconds to look around.")
@click.option("--out", type=click.Path(dir_okay=False, path_type=Path), help="File to write; default: print it.")
def from_graph(*, namespace: str, topics: str, middleware: str, domain_id: int, wait: float, out: Path | None) -> None:
    """Write a registry from the topics that are published on the ROS graph."""
    wanted = [name.strip() for name in topics.split(",") if name.strip()]
    with _participant(middleware, domain_id) as graph:
        time.sleep(wait)  # discovery has no way to say that it is complete
        found = graph.discover()
    text = registry_csv(found, namespace, wanted)
    if out is None:
        print(text, end="")
        return
    try:
        out.write_text(text, encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{out}: cannot be written ({error.strerror})") from error
    print(f"{out}: {len(text.splitlines()) - 1} topics, digest {Registry.from_csv(out).digest}")


def registry_csv(found: Sequence[TopicInfo], namespace: str, wanted: Sequence[str] = ()) -> str:
    """The text of a registry CSV with header.

    :param found: topics of the graph; those that nobody publishes are left out
    :param namespace: only topics below it, by their names relative to it; '' takes all
    :param wanted: only these names, in this order, with or without leading slash; [] takes all by name
    :raises ConfigError: when nothing is left, a wanted topic is missing, or more than 16 remain
    """
    prefix = f"/{namespace.strip('/')}/" if namespace.strip("/") else "/"
    published = {
        info.topic.removeprefix(prefix): info
        for info in sorted(found, key=lambda info: info.topic)
        if info.publishers and info.topic.startswith(prefix) and info.topic not in _INFRASTRUCTURE
    }
    names = [name.lstrip("/").removeprefix(prefix[1:]) for name in wanted] or list(published)
    missing = [name for name in names if name not in published]
    seen = f"published below {prefix} are {', '.join(published) or 'no topics'}"
    if missing:
        raise ConfigError(f"topic {missing[0]!r} is not on the graph; {seen}")
    if not names:
        raise ConfigError(f"nothing to register: {seen}; is the robot running, and in this ROS domain?")
    if len(names) > MAX_TOPICS:
        raise ConfigError(
            f"{len(names)} topics, a registry has at most {MAX_TOPICS}; choose with --namespace or --topics; {seen}"
        )
    latched = {name for name in names if all(qos.durability == "transient_local" for qos in published[name].publishers)}
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["topic", "type", *(["durability"] if latched else [])])
    for name in names:
        durability = ["transient_local" if name in latched else ""] if latched else []
        writer.writerow([name, published[name].type_name, *durability])
    return text.getvalue()


def _participant(middleware: str, domain_id: int) -> Middleware:
    made: Middleware = MIDDLEWARE.load(middleware)(domain_id=domain_id)
    return made


def _options(topic: Topic) -> str:
    default = TopicOptions()
    changed = {item.name: getattr(topic.options, item.name) for item in fields(TopicOptions)}
    return ", ".join(f"{key}={value}" for key, value in changed.items() if value != getattr(default, key))
