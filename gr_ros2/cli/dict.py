"""`gr-ros2 dict`: train a dictionary for message compression on a recording, or list the dictionaries.

Invariant: `train` measures the sizes that it reports, on messages that it did not use for training.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path

import click
from rich import box
from rich.table import Table

from gr_ros2.cli.console import console
from gr_ros2.compression import Dictionary, LinkCodec, load, shipped
from gr_ros2.compression.dictionary import SHIPPED
from gr_ros2.compression.train import learn
from gr_ros2.core.errors import ConfigError
from gr_ros2.middleware.bag_files import bag_contents, read_bag
from gr_ros2.settings.registry import Registry

_HELD_BACK = 4
"""Every fourth message of a topic is kept for measuring."""
_MAX_MESSAGES = 20_000
"""Most messages of one topic. Later messages are left out."""
_FEWEST = 8


@click.group("dict", context_settings={"help_option_names": ["-h", "--help"]})
def group() -> None:
    """Dictionaries for message compression."""


@group.command()
@click.argument("bag", metavar="BAG", type=click.Path(path_type=Path))
@click.option("--out", required=True, type=click.Path(dir_okay=False, path_type=Path), help="File to write.")
@click.option("--topics", default="", metavar="A,B,…", help="Only these topics, by absolute name; default: all.")
@click.option(
    "--size", default=4096, show_default=True, type=click.IntRange(0, 112_640), help="Bytes of zstd dictionary a type."
)
def train(*, bag: Path, out: Path, topics: str, size: int) -> None:
    """Train a dictionary on a recording of your own topics. Give the file to both ends (`dictionaries:`)."""
    wanted = [f"/{name.strip().lstrip('/')}" for name in topics.split(",") if name.strip()]
    messages: dict[str, list[bytes]] = defaultdict(list)
    kinds: dict[str, str] = {}
    for message in read_bag(bag, wanted or None):
        kinds[message.topic] = message.type_name
        if len(messages[message.topic]) < _MAX_MESSAGES:
            messages[message.topic].append(message.payload)
    contents = bag_contents(bag)
    missing = [name for name in wanted if name not in kinds]
    if missing:
        why = contents.left_out.get(missing[0])
        raise ConfigError(
            f"bag {bag}: no messages of topic {missing[0]!r}{f', which is left out: {why}' if why else ''}"
        )
    few = [topic for topic, payloads in messages.items() if len(payloads) < _FEWEST]
    for topic in few:
        del messages[topic]
    if not messages:
        raise ConfigError(f"bag {bag}: no topic with at least {_FEWEST} messages to train on")
    made = learn(
        [
            (kinds[topic], payload)
            for topic, payloads in messages.items()
            for n, payload in enumerate(payloads)
            if n % _HELD_BACK
        ],
        out.stem,
        base=shipped(),
        definitions={name: text for name, text in contents.texts.items() if name in kinds.values()},
        zstd_size=size,
    )
    made.save(out)
    held_back = {topic: payloads[::_HELD_BACK] for topic, payloads in messages.items()}
    console().print(_gains(made, kinds, held_back))
    for line in contents.remarks:
        print(line)
    if few:
        print(f"left out, fewer than {_FEWEST} messages: {', '.join(sorted(few))}")
    print(f"{out}: id {made.digest[:4]}, {len(made.types)} types; both ends need it, under `dictionaries:`")


@group.command("list")
@click.argument("files", metavar="[FILE]…", nargs=-1, type=click.Path(path_type=Path))
def list_dictionaries(*, files: Sequence[Path]) -> None:
    """The types that the shipped dictionaries, or those in FILEs, know."""
    for dictionary in [load(path) for path in files] or map(shipped, SHIPPED):
        table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
        table.add_column("type", overflow="fold")
        for heading in ("fields", "templates", "zstd, B"):
            table.add_column(heading, justify="right")
        for name, entry in dictionary.types.items():
            row = (len(entry.classes), len(entry.templates), len(entry.zstd))
            table.add_row(name, *(str(number) for number in row))
        console().print(table)
        print(
            f"{dictionary.name}: {len(dictionary.types)} types, {len(dictionary.words)} words, "
            f"{len(dictionary.constants)} constants, digest {dictionary.digest[:16]}"
        )


def _gains(made: Dictionary, kinds: Mapping[str, str], messages: Mapping[str, Sequence[bytes]]) -> Table:
    """Mean bytes per message: without compression, with the shipped dictionaries, and with the new one."""
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for heading in ("topic", "type"):
        table.add_column(heading, overflow="fold")
    for heading in ("messages", "raw, B", "shipped, B", "trained, B"):
        table.add_column(heading, justify="right")
    for topic, payloads in sorted(messages.items()):
        registry = Registry.from_rows({"topic": kinds[topic]})
        sizes = [
            sum(len(codec.encode(0, payload)) for payload in payloads) / len(payloads)
            for codec in (LinkCodec(registry), LinkCodec(registry, [made]))
        ]
        raw = sum(map(len, payloads)) / len(payloads)
        table.add_row(topic, kinds[topic], str(len(payloads)), *(f"{size:.1f}" for size in (raw, *sizes)))
    return table
