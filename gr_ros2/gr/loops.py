"""The ROS graphs on which the blocks of this process are, and the loops that are refused between them.

Invariant: a sink must not publish a topic that a source on the same graph subscribes to. Otherwise a message would
circulate without end. Each new block is checked against all other blocks of this process.
"""

from __future__ import annotations

import re
import threading
import weakref
from collections.abc import Iterable
from typing import Any

from gr_ros2.core.errors import ConfigError
from gr_ros2.middleware import Middleware, meet
from gr_ros2.settings.registry import Registry
from gr_ros2.settings.robot import PublishConfig
from gr_ros2.wire import BROADCAST


def check_loop(subscribed: Iterable[str], publish: PublishConfig, registry: Registry) -> None:
    """Refuse a sink that publishes a topic to which a source on the same graph subscribes.

    :param subscribed: absolute names of the topics to which the source subscribes, and of the services that it offers
    :param registry: registry of the sink, with topic options applied
    :raises ConfigError: for a loop; the message names the topic
    """
    names = set(subscribed)
    for merged in publish.merged_topics:
        if merged in names:
            raise ConfigError(
                f"loop: the sink publishes {merged} (publish.merge_tf), which a source on the same graph "
                "subscribes; change that or graph.domain_id"
            )
    for topic in registry:
        for src_id in range(BROADCAST + 1):
            name = topic.republished(publish.as_, src_id)
            if name in names:
                raise ConfigError(
                    f"loop: the sink publishes {name} (sender {src_id}), which a source on the same graph "
                    "subscribes; change publish.as, its publish_as or graph.domain_id"
                )


class LoopGuard:
    """Keeps a list of all blocks of this process, to detect loops between them."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._sources: weakref.WeakKeyDictionary[Any, tuple[Middleware, frozenset[str]]] = weakref.WeakKeyDictionary()
        self._sinks: weakref.WeakKeyDictionary[Any, tuple[Middleware, PublishConfig, Registry]] = (
            weakref.WeakKeyDictionary()
        )
        self._outputs: weakref.WeakKeyDictionary[Any, tuple[Middleware, dict[tuple[int, int], str]]] = (
            weakref.WeakKeyDictionary()
        )
        """Topics that senders have announced, under the names that sinks give them, by sender and topic id."""

    def add_source(self, block: Any, graph: Middleware, subscribed: Iterable[str]) -> None:
        """:raises ConfigError: for a loop with an existing sink"""
        names = frozenset(subscribed)
        with self._lock:
            for other, publish, registry in self._sinks.values():
                if meet(graph, other):
                    check_loop(names, publish, registry)
            self._sources[block] = (graph, names)

    def add_sink(self, block: Any, graph: Middleware, publish: PublishConfig, registry: Registry) -> None:
        """:raises ConfigError: for a loop with an existing source"""
        with self._lock:
            for other, names in self._sources.values():
                if meet(graph, other):
                    check_loop(names, publish, registry)
            self._sinks[block] = (graph, publish, registry)

    def add_output(self, block: Any, graph: Middleware, key: tuple[int, int], name: str) -> None:
        """Note a topic that a sink is about to publish because a sender has announced it.

        :param key: sender and topic id, which have only one name at a time
        :raises ConfigError: for a loop: a source on the same graph subscribes to it
        """
        with self._lock:
            for other, names in self._sources.values():
                if name in names and meet(graph, other):
                    raise ConfigError(
                        f"loop: the sink would publish {name}, which a source on the same graph subscribes; change "
                        "publish.as, its publish_as or graph.domain_id"
                    )
            self._outputs.setdefault(block, (graph, {}))[1][key] = name

    def returns(self, graph: Middleware, name: str) -> bool:
        """Whether a topic of a graph has come by radio: a sink publishes it, or one of another process may do so."""
        with self._lock:
            sinks = [(publish, registry) for other, publish, registry in self._sinks.values() if meet(graph, other)]
            if any(name in names.values() for other, names in self._outputs.values() if meet(graph, other)):
                return True
        formats = {publish.as_ for publish, _ in sinks} | {PublishConfig().as_}
        if any(_made_by(form, name) for form in formats):
            return True
        try:
            for publish, registry in sinks:
                check_loop((name,), publish, registry)
        except ConfigError:
            return True
        return False

    def remove(self, block: Any) -> None:
        """Remove a block that has left its graph."""
        with self._lock:
            self._sources.pop(block, None)
            self._sinks.pop(block, None)
            self._outputs.pop(block, None)


def _made_by(namespace_format: str, name: str) -> bool:
    """Whether a topic is in the namespace that a sink gives to some sender. A format that all senders share does not
    tell."""
    parts = [re.escape(part) for part in namespace_format.strip("/").split("{robot}")]
    return len(parts) > 1 and re.match(f"/{'[0-9]+'.join(parts)}/", name) is not None


LOOP_GUARD = LoopGuard()
