"""`gr-ros2 scenarios`: what can be run by name."""

from __future__ import annotations

import click

from gr_ros2.settings.config import read_yaml
from gr_ros2_lab.run.builtin import SCENARIO_DIR, builtin_scenarios


@click.command()
def scenarios() -> None:
    """List the built-in scenarios, one line each."""
    width = max(map(len, builtin_scenarios()))
    for name in builtin_scenarios():
        print(f"{name:{width}}  {read_yaml(SCENARIO_DIR / f'{name}.yaml')['description']}")
