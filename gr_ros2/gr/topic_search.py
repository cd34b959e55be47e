"""Looks at a ROS graph periodically, for a source that sends topics and offers services which no registry names.

Invariant: one thread, which ends when it is closed, when its graph is closed, or with the process.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping, Sequence

from gr_ros2.errors import MiddlewareError
from gr_ros2.middleware import Middleware, TopicInfo
from gr_ros2.middleware.services import ServiceGraph

LOOK_S = 0.2
"""s between two looks, at least. Messages that are published before the next look are missed, unless their publisher
keeps them."""
_SHARE = 0.05
"""Largest share of time that may be spent looking. rclpy asks for every topic separately."""
_log = logging.getLogger(__name__)


class TopicSearch:
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
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run, name="gr-ros2-topic-search", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop looking. No callback begins after this has returned."""
        self._closed.set()
        if self._thread is not threading.current_thread():
            self._thread.join()

    def _run(self) -> None:
        try:
            while True:
                begin = time.monotonic()
                infos = self._middleware.discover()
                services = {} if self._services is None else self._services.discover_services()
                spent = time.monotonic() - begin
                self._found(infos, services)
                if self._closed.wait(max(LOOK_S, spent / _SHARE)):
                    return
        except MiddlewareError as error:
            _log.warning("no further topics are looked for: %s", error)
