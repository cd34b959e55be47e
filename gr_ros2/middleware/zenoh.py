"""A ROS graph through Zenoh, as nodes with rmw_zenoh see it. Experimental until it has met a real rmw_zenoh.

Invariants: one thread per participant calls back, in the order of arrival; the tables are guarded by one lock, never
held during a callback or a call of Zenoh, whose own threads take it; a message beyond a subscription's depth, and a
message whose number never came, are counted.

Zenoh has no incompatible QoS: every publisher matches every subscription, and an adaptive subscription requests the
messages that the publishers keep. Like rmw_zenoh it needs a router (``ros2 run rmw_zenoh_cpp rmw_zenohd``, or
``zenohd``).
"""

from __future__ import annotations

import atexit
import contextlib
import logging
import os
import threading
import time
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import zenoh
import zenoh.ext

from gr_ros2.core.errors import ConfigError, MiddlewareError
from gr_ros2.middleware import ros_graph
from gr_ros2.middleware.adapt import offered
from gr_ros2.middleware.base import MessageCallback, Middleware, Publisher, Qos, Subscription, TopicInfo, grouped
from gr_ros2.middleware.delivery import CallbackThread, QueuedSubscription
from gr_ros2.middleware.type_definitions import type_hash
from gr_ros2.middleware.zenoh_graph import (
    DEFAULT_DEPTH,
    NO_HASH,
    Entity,
    attachment,
    read_attachment,
    read_token,
    tokens_of,
    topic_key,
)
from gr_ros2.settings.fields import AUTO, Auto
from gr_ros2.settings.registry import normalize_type

_DEFAULTS = {
    "mode": '"peer"',
    "connect/endpoints": '["tcp/localhost:7447"]',
    "listen/endpoints": '["tcp/localhost:0"]',
    "scouting/multicast/enabled": "false",
    "scouting/delay": "1",
    "timestamping/enabled": "true",
}
"""Session configuration of rmw_zenoh: a peer on this machine that finds others through the router."""
_ROUTER_S = 3.0
"""s without a router after which a warning is logged."""
_HEARTBEAT_S = 0.5
_PUBLISHERS_REMEMBERED = 1024

_log = logging.getLogger(__name__)


def session_config(environment: Mapping[str, str] = os.environ) -> Any:
    """The session configuration that rmw_zenoh would use.

    ZENOH_SESSION_CONFIG_URI names a file to take instead of the defaults, ZENOH_CONFIG_OVERRIDE changes single keys
    (``key=value;key=value``, values in JSON5).

    :raises ConfigError: naming the variable and its value
    """
    path = environment.get("ZENOH_SESSION_CONFIG_URI", "").removeprefix("file://")
    try:
        config = zenoh.Config.from_file(Path(path)) if path else zenoh.Config()
        for key, value in () if path else _DEFAULTS.items():
            config.insert_json5(key, value)
    except zenoh.ZError as error:
        raise ConfigError(f"ZENOH_SESSION_CONFIG_URI = {path!r}: {_line(error)}") from error
    for item in filter(str.strip, environment.get("ZENOH_CONFIG_OVERRIDE", "").split(";")):
        key, _, value = item.partition("=")
        try:
            config.insert_json5(key.strip(), value.strip())
        except zenoh.ZError as error:
            raise ConfigError(f"ZENOH_CONFIG_OVERRIDE: {item.strip()!r}: {_line(error)}; write key=value") from error
    return config


class ZenohMiddleware(Middleware):
    """One session with one node.

    :param domain_id: 0..232, auto takes ROS_DOMAIN_ID, default 0
    :param node_name: as ``ros2 node list`` shows it
    :param namespace: of the node
    :raises ConfigError: a name, number or environment variable is malformed
    :raises MiddlewareError: no session can be opened
    :ivar session: the Zenoh session
    """

    name = "zenoh"
    settling_s = 0.1

    def __init__(self, *, domain_id: int | Auto = AUTO, node_name: str = "gr_ros2", namespace: str = "/") -> None:
        super().__init__()
        self.domain_id: int = ros_graph.resolve_domain_id(domain_id)
        self._node_name, self._namespace = ros_graph.check_node(node_name, namespace)
        self._has_hashes = ros_graph.gid_size() != 24
        self._declaring = threading.RLock()  # held during a declaration, so that close() comes before or after
        self._tables = threading.Lock()  # guards the attributes below
        self.closed = False
        self._endpoints: list[_ZenohPublisher | _ZenohSubscription] = []
        self._entities: dict[str, Entity] = {}  # of all participants, by token
        self._numbers = 0
        config = session_config()
        with _failures("no session"):
            self.session: Any = zenoh.open(config)
            self._session_id = str(self.session.zid())
            self._graph = self.session.liveliness().declare_subscriber(
                tokens_of(self.domain_id), self._graph_changed, history=True
            )
            node = Entity(self._session_id, 0, "NN", self._node_name, self._namespace)
            self._token = self.session.liveliness().declare_token(node.token(self.domain_id))
        self.thread = CallbackThread(self, node_name)
        self._patience = threading.Timer(_ROUTER_S, self.thread.call, [self._miss_router])
        self._patience.daemon = True
        self._patience.start()
        atexit.register(self.close)  # an open session would prevent the interpreter from ending

    def subscribe(self, topic: str, type_name: str, qos: Qos, callback: MessageCallback) -> Subscription:
        topic, type_name = ros_graph.check_topic(topic), normalize_type(type_name)
        # A policy that is left open requests the strongest value: Zenoh matches anyway.
        asked = replace(qos, reliability=qos.reliability or "reliable", durability=qos.durability or "transient_local")
        with self._declaring:
            self.check_open(f"subscribe {topic}")
            return _ZenohSubscription(self, self._entity("MS", topic, type_name, asked), callback)

    def advertise(self, topic: str, type_name: str, qos: Qos) -> Publisher:
        topic, type_name = ros_graph.check_topic(topic), normalize_type(type_name)
        with self._declaring:
            self.check_open(f"advertise {topic}")
            return _ZenohPublisher(self, self._entity("MP", topic, type_name, offered(qos)))

    def discover(self) -> list[TopicInfo]:
        """The topics found so far; a new session needs a moment to find any."""
        with self._tables:
            others = [entity for entity in self._entities.values() if entity.session != self._session_id]
        found = [[(e.topic, e.type_name, e.qos) for e in others if e.kind == kind] for kind in ("MP", "MS")]
        return grouped(*found)

    def close(self) -> None:
        with self._tables:
            if self.closed:
                return
            self.closed = True
        atexit.unregister(self.close)
        self._patience.cancel()
        self.thread.close()
        with self._declaring, _failures("close"):
            self.session.close()

    # For our endpoints

    def check_open(self, what: str) -> None:
        """:raises MiddlewareError: once closed"""
        if self.closed:
            raise MiddlewareError(f"{what}: the middleware is closed")

    def join(self, endpoint: _ZenohPublisher | _ZenohSubscription) -> Any:
        """Announce an endpoint to the graph; returns its liveliness token."""
        with self._tables:
            self._endpoints.append(endpoint)
            others = list(self._entities.values())
        for other in others:
            self._compare(endpoint, other)
        return self.session.liveliness().declare_token(endpoint.entity.token(self.domain_id))

    def leave(self, endpoint: _ZenohPublisher | _ZenohSubscription, declared: Iterable[Any]) -> None:
        """Remove an endpoint from the graph."""
        with self._tables:
            self._endpoints.remove(endpoint)
        with self._declaring, _failures(f"close {endpoint.entity.topic}"):
            for thing in () if self.closed else declared:
                thing.undeclare()

    def matches(self, entity: Entity) -> list[Entity]:
        """Entities of the other kind with that topic and type; empty after ``close``."""
        wanted = ("MS" if entity.kind == "MP" else "MP", entity.topic, entity.type_name)
        with self._tables:
            found = [e for e in self._entities.values() if (e.kind, e.topic, e.type_name) == wanted]
            return [] if self.closed else found

    # Internals

    def _miss_router(self) -> None:
        if not self.session.info.routers_zid():
            _log.warning(
                "zenoh: no router found; start one (ros2 run rmw_zenoh_cpp rmw_zenohd), or set "
                "ZENOH_CONFIG_OVERRIDE='connect/endpoints=[\"tcp/HOST:7447\"]'"
            )

    def _entity(self, kind: Any, topic: str, type_name: str, qos: Qos) -> Entity:
        with self._tables:
            self._numbers += 1
            number = self._numbers
            seen = next((e.type_hash for e in self._entities.values() if e.type_name == type_name), "")
        # The type hash that other nodes announce takes precedence: the type need not be one that ROS ships.
        known = seen or (type_hash(type_name) if self._has_hashes else "") or NO_HASH
        return Entity(self._session_id, number, kind, self._node_name, self._namespace, topic, type_name, known, qos)

    def _graph_changed(self, sample: Any) -> None:
        """A token appeared or disappeared. Called in a thread of Zenoh."""
        token = str(sample.key_expr)
        entity = read_token(token)
        if entity is None:
            return
        with self._tables:
            here = sample.kind == zenoh.SampleKind.PUT
            if here:
                self._entities[token] = entity
            else:
                self._entities.pop(token, None)
            endpoints = list(self._endpoints)
        for endpoint in endpoints:
            if here:
                self._compare(endpoint, entity)
            if isinstance(endpoint, _ZenohSubscription) and endpoint.entity.topic == entity.topic:
                endpoint.look()

    def _compare(self, endpoint: _ZenohPublisher | _ZenohSubscription, other: Entity) -> None:
        """Count endpoints of the same topic that cannot match."""
        own = endpoint.entity
        if other.topic != own.topic or {own.kind, other.kind} != {"MP", "MS"}:
            return
        if other.type_name != own.type_name:
            text = f"{own.topic}: another endpoint has type {other.type_name}, this one {own.type_name}"
        elif own.kind == "MP" and other.type_hash != own.type_hash:
            hashes = f"a subscriber has type hash {other.type_hash}, this publisher {own.type_hash}"
            text = f"{own.topic}: {hashes}; set ROS_DISTRO"
        else:
            return
        self.count_once(f"incompatible_type:{own.topic}", text)


class _ZenohPublisher(Publisher):
    """Volatile or, with a cache that late joiners query, transient-local."""

    def __init__(self, middleware: ZenohMiddleware, entity: Entity) -> None:
        self.entity = entity
        self._middleware = middleware
        self._gid = entity.gid(middleware.domain_id)
        self._numbering = threading.Lock()
        self._sequence = 0
        self._closed = False
        qos = entity.qos
        reliable = qos.reliability == "reliable"
        block = reliable and not qos.depth
        options: dict[str, Any] = {
            "reliability": zenoh.Reliability.RELIABLE if reliable else zenoh.Reliability.BEST_EFFORT,
            "congestion_control": zenoh.CongestionControl.BLOCK if block else zenoh.CongestionControl.DROP,
        }
        key = topic_key(middleware.domain_id, entity.topic, entity.type_name, entity.type_hash)
        with _failures(f"advertise {entity.topic}"):
            if qos.durability == "transient_local":
                options["cache"] = zenoh.ext.CacheConfig(qos.depth or DEFAULT_DEPTH)
                options["publisher_detection"] = True
                if reliable:
                    options["sample_miss_detection"] = zenoh.ext.MissDetectionConfig(
                        heartbeat=None, sporadic_heartbeat=_HEARTBEAT_S
                    )
                self._publisher = zenoh.ext.declare_advanced_publisher(middleware.session, key, **options)
            else:
                self._publisher = middleware.session.declare_publisher(key, **options)
            self._token = middleware.join(self)

    def publish(self, payload: bytes) -> None:
        """Publish from any thread; the bytes arrive unchanged.

        :raises MiddlewareError: once closed, or when Zenoh fails
        """
        topic = self.entity.topic
        if self._closed:
            raise MiddlewareError(f"publish on {topic}: the publisher is closed")
        self._middleware.check_open(f"publish on {topic}")
        with self._numbering, _failures(f"publish on {topic}"):
            self._sequence += 1
            beside = attachment(self._sequence, time.time_ns(), self._gid)
            self._publisher.put(bytes(payload), attachment=beside)

    def matched(self) -> int:
        return 0 if self._closed else len(self._middleware.matches(self.entity))

    def close(self) -> None:
        if not self._closed:
            self._closed = True
            self._middleware.leave(self, (self._token, self._publisher))


class _ZenohSubscription(QueuedSubscription):
    """Receives messages of its topic and type with any type hash, since it never parses them."""

    def __init__(self, middleware: ZenohMiddleware, entity: Entity, callback: MessageCallback) -> None:
        super().__init__(middleware, middleware.thread, entity.topic, entity.qos.depth, callback)
        self.entity = entity
        self._middleware = middleware
        self._newest: dict[bytes, int] = {}  # publisher -> number of its newest message
        qos = entity.qos
        key = topic_key(middleware.domain_id, entity.topic, entity.type_name, "*")
        with _failures(f"subscribe {entity.topic}"):
            if qos.durability == "transient_local":
                history = zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=qos.depth or None)
                recovery = None
                if qos.reliability == "reliable":
                    recovery = zenoh.ext.RecoveryConfig(periodic_queries=None, heartbeat=True)
                self._subscriber = zenoh.ext.declare_advanced_subscriber(
                    middleware.session, key, self._heard, history=history, recovery=recovery, subscriber_detection=True
                )
            else:
                self._subscriber = middleware.session.declare_subscriber(key, self._heard)
            self._token = middleware.join(self)

    def matched(self) -> int:
        return 0 if self.closed else len(self._middleware.matches(self.entity))

    def offers(self) -> list[Qos]:
        return [publisher.qos for publisher in self._middleware.matches(self.entity)]

    def leave(self) -> None:
        self._middleware.leave(self, (self._token, self._subscriber))

    def _heard(self, sample: Any) -> None:
        """Called in a thread of Zenoh, one message after the other."""
        if sample.kind != zenoh.SampleKind.PUT:
            return
        beside = read_attachment(sample.attachment.to_bytes()) if sample.attachment else None
        if beside is not None:
            self._count_missing(*beside)
        self.push(sample.payload.to_bytes(), None if beside is None else beside[1])

    def _count_missing(self, sequence: int, gid: bytes) -> None:
        newest = self._newest.get(gid)
        if newest is None and len(self._newest) >= _PUBLISHERS_REMEMBERED:
            del self._newest[next(iter(self._newest))]
        if newest is not None and sequence > newest + 1:
            missing = sequence - newest - 1
            topic = self.entity.topic
            self._middleware.count_lost(self, topic, f"{topic}: messages were lost on the way", missing)
        if newest is None or sequence > newest:
            self._newest[gid] = sequence


@contextlib.contextmanager
def _failures(what: str) -> Iterator[None]:
    """Raises errors of Zenoh as MiddlewareError."""
    try:
        yield
    except zenoh.ZError as error:
        raise MiddlewareError(f"zenoh: {what}: {_line(error)}") from error


def _line(error: BaseException) -> str:
    return " ".join(str(error).split())
