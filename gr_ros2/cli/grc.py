"""`gr-ros2 grc-path`: where GRC finds the blocks."""

from __future__ import annotations

import click

from gr_ros2.grc_path import grc_path as block_folder
from gr_ros2.grc_path import install as install_blocks


@click.command("grc-path")
@click.option("--install", is_flag=True, help="Make GRC find the folder from now on.")
def grc_path(install: bool) -> None:
    """Print the folder of block descriptions for GRC."""
    if install:
        install_blocks()
    print(block_folder())
