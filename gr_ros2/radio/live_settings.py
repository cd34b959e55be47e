"""The settings of a running link that can change, by their names in its YAML file.

Invariant: what can change is what the blocks say, which have a method ``set_<name>`` for each.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from functools import partial
from typing import Any

from gr_ros2.core.errors import ConfigError, shortened
from gr_ros2.gr.link_sending import LinkSendingBlock
from gr_ros2.gr.receiving import ReceivingBlock
from gr_ros2.settings.config import SendOptions
from gr_ros2.settings.registry import options_of

_OPTIONS = "topics"


class LiveSettings:
    """Those of one link.

    :param source: the block that sends
    :param sink: the block that receives
    """

    def __init__(self, source: LinkSendingBlock, sink: ReceivingBlock) -> None:
        self._source = source
        self._setters: dict[str, Callable[[Any], None]] = {
            name: getattr(source, f"set_{name}") for name in source.live_settings
        }
        self._setters |= {name: partial(self._set_both, name) for name in sink.live_settings}
        self._sink = sink
        self._options = source.live_options

    def can_change(self, name: str) -> bool:
        """Whether a setting can change while the link runs; ``topics.TOPIC.OPTION`` for a topic."""
        place = _of_topic(name)
        return name in self._setters if place is None else place[1] in self._options

    def change(self, name: str, value: Any) -> str:
        """Change one setting; returns it in words.

        :raises ConfigError: for one that cannot change, or a value that is not allowed
        """
        if not self.can_change(name):
            these = [*self._setters, f"{_OPTIONS}.TOPIC.{'|'.join(self._options)}"]
            raise ConfigError(f"{name} cannot change while the link runs; these can: {', '.join(these)}")
        place = _of_topic(name)
        if place is None:
            self._setters[name](value)
            return shortened(f"{name} = {value}")
        topic, option = place
        sent = self._source.sent
        topic = sent[topic].name if topic in sent else topic  # as status writes it
        given = self._source.config.topics
        known = next((other for other in given if other.lstrip("/") == topic.lstrip("/")), topic)
        before = options_of(topic, self._source.config.options, SendOptions())
        changed = {**{each.name: getattr(before, each.name) for each in fields(SendOptions)}, option: value}
        self._source.set_topics({**given, known: changed})
        if topic.lstrip("/") in {one.name.lstrip("/") for one in sent.values()}:
            return shortened(f"{name} = {value}")
        names = ", ".join(sorted(sent))
        others = f"sent are {names}" if names else "nothing is sent yet"
        return shortened(f"{name} = {value}; no topic {topic} is sent now, it waits for one; {others}")

    def _set_both(self, name: str, value: Any) -> None:
        """Change what both directions have."""
        for block in (self._source, self._sink):
            getattr(block, f"set_{name}")(value)


def _of_topic(name: str) -> tuple[str, str] | None:
    """Topic and option of a setting of one topic, None for others."""
    if not name.startswith(f"{_OPTIONS}."):
        return None
    topic, _, option = name.removeprefix(f"{_OPTIONS}.").rpartition(".")
    return (topic, option) if topic else None
