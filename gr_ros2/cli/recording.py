"""`--bag FOLDER` and `--pcap FILE`: what a command records."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import click

from gr_ros2.observe.bag import OutputBag
from gr_ros2.observe.capture import PacketCapture

bag_option = click.option(
    "--bag", type=click.Path(path_type=Path), metavar="FOLDER", help="Record what comes out as a ROS 2 bag (MCAP)."
)
pcap_option = click.option(
    "--pcap",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help="Capture every packet for Wireshark (see `gr-ros2 wireshark`).",
)


@contextmanager
def output_bag(path: Path | None) -> Iterator[list[OutputBag]]:
    """The bags of a command: one if a folder is named, otherwise none.

    :raises BagError: when it cannot be made
    """
    if path is None:
        yield []
        return
    with OutputBag(path) as one:
        yield [one]


@contextmanager
def capture(path: Path | None) -> Iterator[list[PacketCapture]]:
    """The captures of a command: one if a file is named, otherwise none.

    :raises ConfigError: when the file cannot be written
    """
    if path is None:
        yield []
        return
    with PacketCapture(path) as one:
        yield [one]
