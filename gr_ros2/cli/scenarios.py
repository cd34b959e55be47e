"""`gr-ros2 scenarios`: what can be run by name."""

from __future__ import annotations

import click

from gr_ros2.settings.config import read_yaml
from gr_ros2.settings.files import BUILTIN_DIR


@click.command()
def scenarios() -> None:
    """List the built-in scenarios, one line each."""
    found = {path.stem: str(read_yaml(path)["description"]) for path in BUILTIN_DIR.glob("*.yaml")}
    width = max(map(len, found))
    for name, description in sorted(found.items()):
        print(f"{name:{width}}  {description}")
