"""Names and types of the topics that the page shows.

Invariant: what a robot has said about its topics has priority over the registry, because a robot may send topics that
no registry here has.
"""

from __future__ import annotations

from collections.abc import Mapping

from gr_ros2.settings.registry import MAX_TOPICS, Registry

Key = tuple[int, int]
"""Source id and topic id."""


class TopicNames:
    """What topic ids mean.

    :param registry: names and types of topic ids, as far as they are known before
    :param names: absolute names that are known before
    """

    def __init__(self, registry: Registry, names: Mapping[Key, str]) -> None:
        self._registry = registry
        self._names = dict(names)
        self._said: dict[Key, tuple[str, str]] = {}

    def learn(self, key: Key, name: str, type_name: str, *, full_name: str = "") -> bool:
        """Take over what a topic id means.

        :param name: of the topic, as in a registry
        :param full_name: absolute name at its source, '' if unknown
        :return: whether that was not known
        """
        if full_name:
            self._names[key] = full_name
        news = self._said.get(key) != (name, type_name)
        self._said[key] = name, type_name
        return news

    def full(self, key: Key) -> str:
        """Absolute name, or one made from the source id if the robot's namespace is not known."""
        return self._names.get(key) or f"/source_{key[0]}/{self.of(key).lstrip('/')}"

    def of(self, key: Key) -> str:
        """Name as in a registry; made from the topic id if nothing is known."""
        return self._meaning(key)[0] or ("announced topics" if key[1] == MAX_TOPICS else f"topic_{key[1]}")

    def type_name(self, key: Key) -> str:
        """Type, '' if unknown."""
        return self._meaning(key)[1]

    def _meaning(self, key: Key) -> tuple[str, str]:
        if key in self._said:
            return self._said[key]
        if key in self._names and key[1] < len(self._registry):
            topic = self._registry[key[1]]
            return topic.name, topic.type_name
        return "", ""
