"""Messages for the contract suite: some for each codec of the table, in the order in which a topic has them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from gr_ros2.codecs import CODECS, CodedTopic, video
from gr_ros2.codecs.messages import CLOUD, COMPRESSED_IMAGE, GRID, IMAGE
from tests.codecs import scenes

PATH = "nav_msgs/msg/Path"
SCAN = "sensor_msgs/msg/LaserScan"


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
        others = {"cloud": "off"} if (self.codec, self.type_name) == ("growing", CLOUD) else {}
        return CodedTopic(self.type_name, {self.codec: self.options, **others})


def _clouds() -> list[bytes]:
    return [scenes.cloud(scenes.street(n, 16, 300), number=n) for n in range(3)]


def _texts() -> list[bytes]:
    return [scenes.write("std_msgs/msg/String", data="a robot " * n) for n in range(4)]


def _maps() -> list[bytes]:
    return scenes.exploring(3, 200)


def _paths() -> list[bytes]:
    return [scenes.path(20 * n) for n in range(4)]


def _colours() -> list[bytes]:
    return [scenes.image(scenes.view(n, 160, 120), "rgb8", n) for n in range(5)]


def _jpegs() -> list[bytes]:
    return [
        scenes.compressed(video.packed("mjpeg", scenes.picture(scenes.view(n, 160, 120), "yuvj420p")), "jpeg", n)
        for n in range(5)
    ]


def _depths() -> list[bytes]:
    return [scenes.image(np.rint(scenes.room(n, 160, 120) * 1000).astype("<u2"), "16UC1", n) for n in range(5)]


def _metres() -> list[bytes]:
    return [scenes.image(scenes.room(n, 160, 120), "32FC1", n) for n in range(3)]


def _scans() -> list[bytes]:
    return [scenes.scan(n) for n in range(3)]


SAMPLES = {
    "exact": Sample("exact", "std_msgs/msg/String", {}, cache(_texts), exact=True),
    "camera": Sample("camera", IMAGE, {"size": "full"}, cache(_colours), budget=1200),
    "camera of JPEG": Sample("camera", COMPRESSED_IMAGE, {}, cache(_jpegs), budget=1200),
    "camera to Foxglove": Sample("camera", IMAGE, {"output_type": "CompressedVideo"}, cache(_colours), budget=600),
    "camera to FFmpeg": Sample("camera", COMPRESSED_IMAGE, {"output_type": "FFMPEGPacket"}, cache(_jpegs)),
    "camera to JPEG": Sample("camera", IMAGE, {"output_type": "CompressedImage"}, cache(_colours)),
    "depth": Sample("depth", IMAGE, {}, cache(_depths), budget=900),
    "depth in 8 bits": Sample("depth", IMAGE, {"mode": "8"}, cache(_depths)),
    "depth in metres": Sample("depth", IMAGE, {}, cache(_metres)),
    "cloud": Sample("cloud", CLOUD, {}, cache(_clouds), exact=True),
    "cloud as voxels": Sample("cloud", CLOUD, {"voxel": 0.2, "range": 30.0}, cache(_clouds)),
    "cloud with intensity": Sample("cloud", CLOUD, {"voxel": 0.2, "keep": "intensity"}, cache(_clouds)),
    "cloud in a budget": Sample("cloud", CLOUD, {"voxel": 0.05}, cache(_clouds), budget=900),
    "grid": Sample("grid", GRID, {}, cache(_maps), exact=True),
    "cloud that grows": Sample("growing", CLOUD, {}, cache(_clouds), exact=True),
    "path": Sample("growing", PATH, {}, cache(_paths), exact=True),
}
if "scan" in CODECS:  # the worked example of docs/how-to/extend.md, where a test has installed it
    SAMPLES["scan"] = Sample("scan", SCAN, {}, cache(_scans), exact=True)
