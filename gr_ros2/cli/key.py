"""`gr-ros2 key`: keys that seal a fleet's packets."""

from __future__ import annotations

from pathlib import Path

import click

from gr_ros2.state.keys import new_key_file


@click.group("key", context_settings={"help_option_names": ["-h", "--help"]})
def group() -> None:
    """Keys that seal a fleet's packets, so that nobody else can read, forge or replay them."""


@group.command()
@click.argument("file", metavar="FILE", type=click.Path(path_type=Path))
def new(*, file: Path) -> None:
    """Make a key. Copy FILE to every robot of the fleet, and name it as `key` in the configuration of each link."""
    new_key_file(file)
    print(f"{file}: a new key; copy it to every robot of the fleet, readable by its owner only")
