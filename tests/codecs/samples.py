"""Messages for the contract suite: some for each codec of the table, in the order in which a topic has them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache
from typing import Any, NamedTuple

from gr_ros2.codecs import CodedTopic
from gr_ros2.codecs.messages import CLOUD, GRID
from tests.codecs import scenes


class Sample(NamedTuple):
    """A topic that a codec codes.

    :param options: of that codec
    :param budget: bytes of a frame
    """

    codec: str
    type_name: str
    options: Mapping[str, Any]
    messages: Callable[[], list[bytes]]
    budget: int | None = None
    exact: bool = False

    def topic(self) -> CodedTopic:
        return CodedTopic(self.type_name, {self.codec: self.options})


def _clouds() -> list[bytes]:
    return [scenes.cloud(scenes.street(n, 16, 300), number=n) for n in range(3)]


def _texts() -> list[bytes]:
    return [scenes.write("std_msgs/msg/String", data="a robot " * n) for n in range(4)]


def _maps() -> list[bytes]:
    return scenes.exploring(3, 200)


SAMPLES = {
    "exact": Sample("exact", "std_msgs/msg/String", {}, cache(_texts), exact=True),
    "cloud": Sample("cloud", CLOUD, {}, cache(_clouds), exact=True),
    "cloud as voxels": Sample("cloud", CLOUD, {"voxel": 0.2, "range": 30.0}, cache(_clouds)),
    "cloud with intensity": Sample("cloud", CLOUD, {"voxel": 0.2, "keep": "intensity"}, cache(_clouds)),
    "cloud in a budget": Sample("cloud", CLOUD, {"voxel": 0.05}, cache(_clouds), budget=900),
    "grid": Sample("grid", GRID, {}, cache(_maps), exact=True),
}
