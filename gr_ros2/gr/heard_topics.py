"""What the topic ids of other robots mean to a ROS Sink: from their announcements, or from a registry."""

from __future__ import annotations

from gr_ros2.core.errors import ConfigError
from gr_ros2.settings.registry import Registry, Topic, options_of
from gr_ros2.settings.robot import PublishConfig, PublishOptions

Key = tuple[int, int]
"""Source id and topic id."""


class HeardTopics:
    """The topics of all robots that are heard, by source id and topic id."""

    def __init__(self, registry: Registry, publish: PublishConfig) -> None:
        self._registry, self._publish = registry, publish
        self._announced: dict[Key, Topic] = {}

    def announce(self, key: Key, topic: Topic) -> None:
        """A robot says what a topic id means."""
        self._announced[key] = topic

    def announced(self) -> list[tuple[int, str, Topic]]:
        """Source id, absolute name here and meaning of each topic that is announced now."""
        return [(key[0], self.name(key), topic) for key, topic in list(self._announced.items())]

    def name_of(self, src_id: int, name: str) -> str:
        """Absolute name under which a sender's topic comes out, by its name in a registry."""
        named = options_of(name, self._publish.topics, PublishOptions()).as_
        return Topic(0, name, "", publish_as=named).republished(self._publish.as_, src_id)

    def name(self, key: Key) -> str:
        """Absolute name under which a topic comes out."""
        return self.topic(key).republished(self._publish.as_, key[0])

    def topic(self, key: Key) -> Topic:
        """The topic that a sender's topic id means, from its announcement or from the registry.

        :raises ConfigError: when the topic id is in neither of them
        """
        topic = self._announced.get(key)
        if topic is not None:
            return topic
        if key[1] < len(self._registry):
            return self._registry[key[1]]
        raise ConfigError(f"topic id {key[1]} of robot {key[0]} is neither announced nor in the registry")

    def is_topic(self, key: Key) -> bool:
        """Whether a sender's topic id means a topic: neither its table, nor its calls, nor something unknown."""
        topic = self._announced.get(key)
        return key[1] < len(self._registry) if topic is None else topic.is_topic
