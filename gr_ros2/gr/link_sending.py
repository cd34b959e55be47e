"""The half of a link's block that sends topics which need not be known when it is made."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

from gr_ros2.gr.found_topics import FoundTopics
from gr_ros2.gr.sending import SendingBlock, Sharing
from gr_ros2.gr.subscriptions import OpenSubscriptions
from gr_ros2.link.endpoint import OpenEndpoint
from gr_ros2.settings.config import replaced
from gr_ros2.settings.registry import Registry, Topic
from gr_ros2.settings.robot import RobotConfig


class SharingTopics(Sharing, Protocol):
    """The same of a block whose topics may change."""

    @property
    def sources(self) -> Sequence[LinkSendingBlock]:
        """What sends topics of the same robot over one radio alone."""

    def set_topics(self, topics: Any) -> None:
        """As :meth:`LinkSendingBlock.set_topics`."""


class LinkSendingBlock(SendingBlock):
    """Sends topics that need not be known when it is made.

    :ivar found: what it looks for
    """

    _subscribes = OpenSubscriptions
    subscriptions: OpenSubscriptions
    sharing: SharingTopics | None
    _end: OpenEndpoint

    def __init__(self, config: RobotConfig, registry: Registry, *arguments: Any, **options: Any) -> None:
        super().__init__(config, registry, *arguments, **options)
        self.found = FoundTopics(config, self.middleware, self.subscriptions, self._log)

    def unmatched(self) -> list[str]:
        return self.found.unmatched()

    def start(self) -> bool:
        super().start()
        self.found.start()
        if self.sharing is not None:
            self.sharing.start()
        return True

    def stop(self) -> bool:
        if self.sharing is not None:
            self.sharing.stop()
        self.found.stop()
        return super().stop()

    def close(self) -> None:
        if hasattr(self, "found"):
            self.found.stop()
        super().close()

    def measure_air(self) -> None:
        """Count from now on how much of the air is used."""
        with self._lock:
            self._end.used_air.on = True

    def air_for(self, size: float) -> tuple[float, float]:
        """Bytes of the air that a message of so many bytes takes, and bytes/s that are free."""
        with self._lock:
            air = self._end.used_air
            return air.cost(size), air.free(self.clock())

    @property
    def live_options(self) -> Sequence[str]:
        """Options of a topic that may change while it runs."""
        return self._end.live_options

    @property
    def together(self) -> list[LinkSendingBlock]:
        """This block, and those of the same robot that send over one radio alone."""
        return [self, *(() if self.sharing is None else self.sharing.sources)]

    @property
    def sent(self) -> dict[str, Topic]:
        """The topics that these subscribe to, by their names on the ROS graph."""
        return {name: topic for block in self.together for name, topic in block.subscriptions.subscribed.items()}

    def set_topics(self, topics: Any) -> None:
        """Use other options of single topics, of which ``live_options`` may change. A message is for the robot that
        ``to`` named when the ROS graph handed it over."""
        with self._lock:
            config = replaced(self.config, topics=topics)
            self.subscriptions.change(config.options)
            self.config = config
            self.live.wake()
            self._space.notify_all()
        if self.sharing is not None:
            self.sharing.set_topics(topics)
