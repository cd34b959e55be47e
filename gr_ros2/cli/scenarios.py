"""`gr-ros2 scenarios`: what can be run by name."""

from __future__ import annotations

import click

from gr_ros2.run.scenario import builtin_scenarios


@click.command()
def scenarios() -> None:
    """List the built-in scenarios, one line each."""
    found = list(builtin_scenarios())
    width = max(len(scenario.name) for scenario in found)
    for scenario in found:
        print(f"{scenario.name:{width}}  {scenario.description}")
