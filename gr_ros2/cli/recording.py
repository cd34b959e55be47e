"""`--bag FOLDER` and `--pcap FILE`: what a command records."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

import click

from gr_ros2.core.closing import Closing

_Recorder = TypeVar("_Recorder", bound=Closing)

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
def recording(kind: Callable[[Path], _Recorder], path: Path | None) -> Iterator[list[_Recorder]]:
    """The recorders of one kind that a command has: one if a file is named, otherwise none.

    :raises BagError, ConfigError: when it cannot be made
    """
    if path is None:
        yield []
        return
    with kind(path) as one:
        yield [one]
