"""The bag of what a simulated run delivered.

Invariants: a message is written when it is delivered; its arrival is the time of reception and its submission the time
of sending (MCAP's log_time and publish_time), both on the run's clock since the origin; payloads, including header
stamps, are not changed.
"""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Collection, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Literal

from gr_ros2.core.errors import BagError, ConfigError
from gr_ros2.core.files import make_folder
from gr_ros2.link.events import Delivered
from gr_ros2.middleware.bag_files import RecordedTopic, read_bag
from gr_ros2.middleware.bag_recorder import BagChannel, BagRecorder
from gr_ros2.middleware.base import Qos
from gr_ros2.settings.registry import Registry
from gr_ros2_lab.run.scenario import Scenario


class DeliveredBag:
    """A ROS 2 bag of deliveries.

    :param path: folder that does not exist yet
    :param origin_ns: the run's time 0, ns since 1970
    :param storage: ``sqlite3`` stores the time of arrival only
    :param definitions: ``.msg`` texts by type name; types that are not in it use the definitions of ROS
    :raises BagError: when it exists already or cannot be made
    :raises ConfigError: when the folder around it cannot be made
    """

    def __init__(
        self,
        path: Path,
        origin_ns: int,
        storage: Literal["mcap", "sqlite3"] = "mcap",
        definitions: Mapping[str, str] | None = None,
    ) -> None:
        self.written: Counter[str] = Counter()
        """Messages by topic."""
        self.not_recorded: Counter[str] = Counter()
        """Messages that could not be written to disk, by reason. :meth:`close` raises the error."""
        self._origin_ns = origin_ns
        make_folder(path.parent)
        self._recorder = BagRecorder(path, storage, definitions or {}, self._count)
        self._channels: dict[tuple[int, int], BagChannel] = {}

    def add_source(self, src_id: int, registry: Registry, names: Mapping[int, str]) -> None:
        """Add the topics that come from one sender, with the default QoS.

        :param names: names of the topics in the bag, by topic id
        """
        for topic_id, name in names.items():
            qos = Qos("reliable", "volatile", 10)
            self._channels[src_id, topic_id] = self._recorder.channel(name, registry[topic_id].type_name, qos)

    def copy_source(self, src_id: int, topics: Mapping[int, RecordedTopic]) -> None:
        """Add the topics that come from one sender, by topic id, each as it is in the bag that was sent."""
        for topic_id, topic in topics.items():
            self._channels[src_id, topic_id] = self._recorder.copy(topic)

    def take(self, event: Delivered, now: float, submitted: float | None) -> None:
        """Write one delivery; times are s since the origin.

        :raises BagError: when the file cannot be written
        """
        channel = self._channels.get((event.src_id, event.topic_id))
        if channel is None:
            self._count("unknown_topic", f"source {event.src_id}, topic {event.topic_id}")
            return
        arrival_ns = self._origin_ns + round(now * 1e9)
        sent_ns = arrival_ns if submitted is None else self._origin_ns + round(submitted * 1e9)
        self._recorder.write(channel, arrival_ns, event.message, sent_ns)
        self.written[channel.topic] += 1

    def close(self) -> None:
        """Finish the file.

        :raises BagError: when it could not be written
        """
        self._recorder.close()

    def __enter__(self) -> DeliveredBag:
        return self

    def __exit__(self, kind: object, *error: object) -> None:
        """Finish the file. If the run failed or was interrupted, the file is removed."""
        if kind is None:
            self.close()
            return
        with suppress(BagError):
            self.close()
        shutil.rmtree(self._recorder.path, ignore_errors=True)

    def _count(self, what: str, why: str) -> None:  # noqa: ARG002 - the reason comes with the error
        self.not_recorded[what] += 1


def bag_origin_ns(scenario: Scenario, topics: Collection[str]) -> int:
    """ns since 1970 at the run's time 0: the first message of a recording, or the start time of the simulator.

    A recording that begins before 1970, which MCAP has no stamps for, is taken to begin then.

    :param topics: absolute names of the topics that count
    :raises ConfigError: when the recording has none of the scenario's topics
    """
    if scenario.bag_path is None:
        return round(scenario.sim.start_time_s * 1e9)
    first = next(iter(read_bag(scenario.bag_path, topics)), None)
    if first is None:
        raise ConfigError(f"{scenario.bag_path}: has no messages on {', '.join(topics)}")
    return max(first.stamp_ns, 0)
