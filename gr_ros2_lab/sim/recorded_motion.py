"""Where robots were, by the odometry of a recording.

Invariant: between two messages a robot moves in a straight line; before its first and after its last it stands.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_typestore

from gr_ros2.core.arrays import Floats
from gr_ros2.core.errors import ConfigError
from gr_ros2.middleware.bag_files import bag_contents, read_bag

ODOMETRY = "nav_msgs/msg/Odometry"
_STORE = get_typestore(Stores.ROS2_HUMBLE)
_LATER_S = 0.1
"""s over which a velocity is taken."""


class RecordedMotion:
    """The robots of a recording, of which some have odometry.

    :param namespaces: of the robots, in their order. One that is None, or that the recording has no odometry of, takes
        that of a namespace nobody else has; where there is none, it stands
    :param speed: of the playback
    :param topics: absolute names; their first message is t = 0
    :param stands: where, m; None: where the first robot set out
    :raises ConfigError: for a recording without odometry of the first robot
    :raises BagError: for one that cannot be read
    """

    def __init__(
        self,
        path: Path,
        namespaces: Sequence[str | None],
        *,
        speed: float,
        topics: Collection[str],
        stands: Floats | None = None,
    ) -> None:
        known = bag_contents(path).topics
        odometry = [name for name, topic in known.items() if topic.info.type_name == ODOMETRY]
        chosen = [_of(namespace, odometry) for namespace in namespaces]
        if chosen[0] is None:
            raise ConfigError(
                f"channel.from = 'positions': {path} has no odometry of {namespaces[0] or '/'}; it has "
                f"{', '.join(odometry) or 'none at all'}"
            )
        spare = [name for name in odometry if name not in chosen]
        self._robots = [name or (spare.pop(0) if spare else None) for name in chosen]
        rows: dict[str, list[tuple[float, float, float]]] = defaultdict(list)
        first = None
        for message in read_bag(path, {*topics, *odometry}):
            if first is None and message.topic in topics:
                first = message.stamp_ns
            if message.topic in self._robots:
                place: Any = _STORE.deserialize_cdr(message.payload, ODOMETRY)
                rows[message.topic].append((message.stamp_ns, place.pose.pose.position.x, place.pose.pose.position.y))
        self._tracks = {name: np.array(track).T for name, track in rows.items()}
        for track in self._tracks.values():
            track[0] = (track[0] - (first or 0)) * 1e-9 / speed
        self._start = self._tracks[chosen[0]][1:, 0] if stands is None else stands

    def at(self, now: float) -> tuple[Floats, Floats]:
        """Places in m and velocities in m/s of all robots, each of shape (robots, 2)."""
        here, there = self._places(now), self._places(now + _LATER_S)
        return here, (there - here) / _LATER_S

    def _places(self, now: float) -> Floats:
        places = []
        for name in self._robots:
            track = self._tracks.get(name or "")
            places.append(self._start if track is None else [np.interp(now, track[0], row) for row in track[1:]])
        return np.array(places)


def _of(namespace: str | None, topics: Sequence[str]) -> str | None:
    """The odometry topic in a namespace, the shortest name first."""
    if namespace is None:
        return None
    inside = [name for name in topics if name.startswith(namespace.rstrip("/") + "/")]
    return min(inside, key=len, default=None)
