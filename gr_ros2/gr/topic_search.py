"""Looks at a ROS graph periodically, for a source that sends topics and offers services which no registry names.

Invariant: one thread, which ends when it is closed, when its graph is closed, or with the process.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping, Sequence

from gr_ros2.core.errors import MiddlewareError
from gr_ros2.middleware import Middleware, TopicInfo
from gr_ros2.middleware.graph_search import GraphSearch
from gr_ros2.middleware.services import ServiceGraph

LOOK_S = 0.2
"""s between two looks, at least. Messages that are published before the next look are missed, unless their publisher
keeps them."""
_SHARE = 0.05
"""Largest share of time that may be spent looking."""
_log = logging.getLogger(__name__)


class TopicSearch(GraphSearch):
    """Calls a function with what is on a graph, at once and then every ``LOOK_S`` seconds.

    :param found: called with all topics that are there, and with the types of all services by name, without those of
        this participant; must not raise
    :param services: whether to look for services too. On a graph that has topics only, there are none
    """

    def __init__(
        self,
        middleware: Middleware,
        found: Callable[[Sequence[TopicInfo], Mapping[str, str]], None],
        *,
        services: bool = False,
    ) -> None:
        self._middleware = middleware
        self._services = middleware if services and isinstance(middleware, ServiceGraph) else None
        self._found = found
        super().__init__("gr-ros2-topic-search", LOOK_S, _SHARE)

    def _look(self) -> float:
        infos = self._middleware.discover()
        services = {} if self._services is None else self._services.discover_services()
        begin = time.monotonic()
        self._found(infos, services)
        return time.monotonic() - begin

    def _failed(self, error: MiddlewareError) -> None:
        _log.warning("no further topics are looked for: %s", error)
