"""`gr-ros2 medium`: one simulated channel for links with front end zmq, until Ctrl-C."""

from __future__ import annotations

from math import inf
from pathlib import Path

import click

from gr_ros2.cli.params import Number, set_option
from gr_ros2_lab.medium.process import MediumConfig, MediumProcess, load_medium


@click.command()
@click.argument("config", type=click.Path(path_type=Path))
@click.option("--duration", type=Number(min=0, min_open=True), help="Seconds to run; default until Ctrl-C.")
@set_option(MediumConfig)
def medium(config: Path, duration: float | None, overrides: tuple[str, ...]) -> int:
    """Let the links of several processes or machines share one simulated channel, with collisions, gains and noise.

    CONFIG is a YAML file with phy, robots and channel (docs/how-to/radios.md).
    """
    settings = load_medium(config, overrides)
    process = MediumProcess(settings)
    try:
        click.echo(f"{settings.name}: {len(settings.robots)} robots, {settings.time}; Ctrl-C ends it")
        process.run(inf if duration is None else duration)
    except KeyboardInterrupt:
        pass
    finally:
        process.close()
    click.echo(", ".join(f"{name} {count}" for name, count in sorted(process.counted.items())) or "no burst")
    return 0
