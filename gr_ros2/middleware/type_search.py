"""Asks the nodes of a ROS graph what types are that no distribution of ROS ships, or ships with another definition.

Invariants: one thread, which ends when it is closed, when its graph is closed, or with the process; it asks one node at
a time; a definition is handed on once per hash, and only if it has the hash that the graph announces. Nothing waits for
this thread.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable

from gr_ros2.core.errors import DescriptionError, GrRos2Error, MiddlewareError
from gr_ros2.middleware.graph_search import GraphSearch
from gr_ros2.middleware.services import DESCRIPTION_TYPE, ServiceGraph
from gr_ros2.middleware.type_definitions import ships
from gr_ros2.middleware.type_descriptions import Described, read_reply, request

LOOK_S = 0.5
"""s between two looks, at least."""
_SHARE = 0.02
"""Largest share of time that may be spent looking."""
REPLY_S = 5.0
"""s that a node has for its reply, discovery of its service included."""
TRIES = 3
"""How often a node is asked for a type at most."""
_ASKED = 1
"""Number of the only request of a client."""

_log = logging.getLogger(__name__)


class TypeSearch(GraphSearch):
    """Learns types until it is closed.

    :param wanted: returns the topics in use, by absolute name and type; must not raise
    :param learned: called with each new definition, in the thread of the search; must not raise
    """

    def __init__(
        self,
        graph: ServiceGraph,
        wanted: Callable[[], Iterable[tuple[str, str]]],
        learned: Callable[[Described], None],
    ) -> None:
        self._graph, self._wanted, self._learned = graph, wanted, learned
        self._done: set[str] = set()
        """Hashes of the types that are known."""
        self._asked: Counter[tuple[str, str]] = Counter()
        """How often a node was asked, by hash and service."""
        super().__init__("gr-ros2-type-search", LOOK_S, _SHARE)

    def _look(self) -> float:
        return sum(self._look_for(topic, type_name) for topic, type_name in self._wanted())

    def _failed(self, error: MiddlewareError) -> None:
        if not self._closed.is_set():
            _log.debug("no further types are asked for: %s", error)

    def _look_for(self, topic: str, type_name: str) -> float:
        """Ask about the type of one topic. Returns the s that it waited for nodes."""
        begin = time.monotonic()
        for witness in self._graph.witnesses(topic, type_name):
            if witness.digest in self._done or ships(type_name, witness.digest):
                continue
            for service in witness.services:
                if self._closed.is_set() or self._asked[witness.digest, service] >= TRIES:
                    continue
                self._asked[witness.digest, service] += 1
                described = self._ask(service, type_name, witness.digest)
                if described is not None and not self._closed.is_set():
                    self._done.add(witness.digest)
                    _log.info("%s is known from %s: %s", type_name, service, witness.digest)
                    self._learned(described)
                    break
        return time.monotonic() - begin

    def _ask(self, service: str, type_name: str, digest: str) -> Described | None:
        there, replied = threading.Event(), threading.Event()
        replies: list[bytes] = []

        def on_server(available: bool) -> None:
            if available:
                there.set()

        def on_reply(_: int, payload: bytes) -> None:
            replies.append(payload)
            replied.set()

        try:
            client = self._graph.client(service, DESCRIPTION_TYPE, on_reply, on_server)
        except GrRos2Error as error:
            _log.debug("%s cannot be asked: %s", service, error)
            return None
        try:
            deadline = time.monotonic() + REPLY_S
            if self._waits(there, deadline):
                client.call(_ASKED, request(type_name, digest))
                if self._waits(replied, deadline):
                    return read_reply(replies[0], type_name, digest)
            _log.debug("%s has not replied about %s", service, type_name)
        except DescriptionError as error:
            _log.info("%s: %s", service, error)
        except MiddlewareError as error:
            _log.debug("%s was not asked about %s: %s", service, type_name, error)
        finally:
            client.close()
        return None

    def _waits(self, event: threading.Event, deadline: float) -> bool:
        """Wait for an event, the deadline or the end of the search; returns whether the event came."""
        while not event.is_set() and not self._closed.is_set() and time.monotonic() < deadline:
            event.wait(0.05)
        return event.is_set() and not self._closed.is_set()
