"""`gr-ros2 grc-path`: where GRC finds the blocks, and how its Python finds what they need."""

from __future__ import annotations

import click

from gr_ros2.core.errors import ConfigError
from gr_ros2.grc.path import grc_path as block_folder
from gr_ros2.grc.path import install as install_blocks
from gr_ros2.grc.path import uninstall as uninstall_blocks
from gr_ros2.grc.python import ask, grc_program, provide, withdraw


@click.command("grc-path")
@click.option("--install", is_flag=True, help="Make GRC, and the Python it runs in, find the blocks from now on.")
@click.option("--uninstall", is_flag=True, help="Take that back.")
def grc_path(install: bool, uninstall: bool) -> None:
    """Print the folder of block descriptions for GRC."""
    if install and uninstall:
        raise click.UsageError("--install or --uninstall, not both")
    if install:
        other = ask(grc_program())
        written = provide(other)
        install_blocks()
        where = f"by {written}" if written is not None else "by itself"
        click.echo(f"{other.program} finds gr-ros2 {where}; start gnuradio-companion as always.", err=True)
    if uninstall:
        gone = uninstall_blocks()
        try:
            gone += withdraw(ask(grc_program()))
        except ConfigError as error:
            click.echo(f"gr-ros2: {error}", err=True)
        click.echo(f"taken back: {', '.join(map(str, gone)) or 'nothing was there'}", err=True)
        return
    print(block_folder())
