"""The embedded middleware: a DDS participant that ROS 2 nodes see and communicate with, without a ROS installation.

Invariants: one thread per participant receives, discovers and calls back; one lock protects its tables, and is never
held during a callback or a wait.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial

from gr_ros2.core.errors import MiddlewareError
from gr_ros2.middleware import ros_graph
from gr_ros2.middleware.adapt import offered
from gr_ros2.middleware.base import MessageCallback, Qos, TopicInfo
from gr_ros2.middleware.cdr_dds import (
    DdsError,
    EndpointWatch,
    Entity,
    RawReader,
    RawWriter,
    create_topic,
    guid,
)
from gr_ros2.middleware.dds_domains import POOL
from gr_ros2.middleware.dds_endpoints import SLACK, DdsPublisher, DdsSubscription
from gr_ros2.middleware.dds_events import DdsEvents
from gr_ros2.middleware.dds_found import FoundEndpoints
from gr_ros2.middleware.dds_services import DdsClient, DdsPairs, DdsServer, ServiceParticipant
from gr_ros2.middleware.services import ReplyCallback, RequestCallback, ServerCallback, Witness
from gr_ros2.settings.fields import AUTO, Auto
from gr_ros2.settings.registry import normalize_type

_DISCOVERY_QOS = Qos("reliable", "transient_local", 1)

_log = logging.getLogger(__name__)


class DdsMiddleware(ServiceParticipant):
    """A participant.

    :param domain_id: 0..232, auto takes ROS_DOMAIN_ID, default 0
    :param node_name: as ``ros2 node list`` shows it
    :param namespace: of the node
    :param localhost_only: use the loopback interface only; auto takes ROS_LOCALHOST_ONLY. Where both are unset,
        ROS_AUTOMATIC_DISCOVERY_RANGE and ROS_STATIC_PEERS apply
    :raises ConfigError: a name, number or environment variable is malformed, or the domain is open with other options
    :raises MiddlewareError: the domain cannot be joined
    """

    name = "dds"
    settling_s = 0.1

    def __init__(
        self,
        *,
        domain_id: int | Auto = AUTO,
        node_name: str = "gr_ros2",
        namespace: str = "/",
        localhost_only: bool | Auto = AUTO,
    ) -> None:
        super().__init__()
        self.domain_id: int = ros_graph.resolve_domain_id(domain_id)
        options = ros_graph.discovery_options(localhost_only)
        self._node = ros_graph.check_node(node_name, namespace)
        self._gid_bytes = ros_graph.gid_size(os.environ)
        self.closed = False
        self._closing = threading.Lock()
        self._lock = threading.Lock()  # for the tables below; held only briefly, never during a callback
        self._announcing = threading.Lock()
        self._topics: dict[tuple[str, str], Entity] = {}
        self._subscriptions: list[DdsSubscription] = []
        self._advertised: list[DdsPublisher] = []
        self._participant = POOL.join(self.domain_id, options, ros_graph.PARTICIPANT_USER_DATA)
        try:
            self.own_guid = guid(self._participant)
            self._others = FoundEndpoints(self.own_guid)
            self._events = DdsEvents(self._participant)
            self.pairs = DdsPairs(self, self._participant, self._events, self._others)
            for publishers in (True, False):
                watch = EndpointWatch(self._participant, publishers=publishers)
                changed = partial(self._graph_changed, watch, publishers=publishers)
                self._events.attach(watch.condition, (watch.condition,), changed)
            topic = create_topic(self._participant, ros_graph.DISCOVERY_TOPIC, ros_graph.DISCOVERY_TYPE)
            self._discovery = RawWriter(self._participant, topic, _DISCOVERY_QOS, ros_graph.DISCOVERY_USER_DATA)
            self.announce()
        except BaseException:
            POOL.leave(self.domain_id, self._participant)
            raise
        self._thread = threading.Thread(target=self._run, name=f"dds-{self.domain_id}-{node_name}", daemon=True)
        self._thread.start()

    def subscribe(self, topic: str, type_name: str, qos: Qos, callback: MessageCallback) -> DdsSubscription:
        topic, type_name = ros_graph.check_topic(topic), normalize_type(type_name)
        self._check_open(f"subscribe {topic}")
        subscription = DdsSubscription(self, topic, type_name, qos, callback)
        with self._lock:
            self._subscriptions.append(subscription)
        try:
            subscription.adapt(self._offers(topic, type_name))
        except MiddlewareError:
            with self._lock:
                self._subscriptions.remove(subscription)
            raise
        return subscription

    def advertise(self, topic: str, type_name: str, qos: Qos) -> DdsPublisher:
        topic, type_name = ros_graph.check_topic(topic), normalize_type(type_name)
        self._check_open(f"advertise {topic}")
        writer = RawWriter(self._participant, self._topic(topic, type_name), offered(qos), self._user_data(type_name))
        publisher = DdsPublisher(self, topic, writer)
        with self._lock:
            self._advertised.append(publisher)
        self._events.attach(writer.entity, (writer.entity,), publisher.service)
        self.announce()
        return publisher

    def serve(self, service: str, type_name: str, on_request: RequestCallback, node: str = "") -> DdsServer:
        self._check_open(f"serve {service}")
        server = DdsServer(self, ros_graph.check_topic(service), type_name, on_request, node)
        self.pairs.add(server)
        return server

    def client(self, service: str, type_name: str, on_reply: ReplyCallback, on_server: ServerCallback) -> DdsClient:
        self._check_open(f"call {service}")
        return DdsClient(self, ros_graph.check_topic(service), type_name, on_reply, on_server)

    def discover(self) -> list[TopicInfo]:
        """The topics seen so far; a fresh participant needs a moment (tenths of a second) to see any."""
        return self._others.topics()

    def discover_services(self) -> dict[str, str]:
        return {name: type_name for name, type_name, _ in self._others.servers()}

    def uncallable(self) -> frozenset[str]:
        return frozenset(name for name, _, callable_here in self._others.servers() if not callable_here)

    def witnesses(self, topic: str, type_name: str) -> list[Witness]:
        return self._others.witnesses(topic, type_name)

    def close(self) -> None:
        worker = threading.current_thread() is self._thread
        if worker and self.closed:
            return
        with self._closing:
            if self.closed:
                return
            self.closed = True
            with self._lock:
                subscriptions = list(self._subscriptions)
            for subscription in subscriptions:
                subscription.mute()
            self._events.wake()
            self.wait_for_thread(self._thread)
            POOL.leave(self.domain_id, self._participant)

    # Methods for publishers and subscriptions.

    def make_reader(self, subscription: DdsSubscription, qos: Qos) -> RawReader:
        topic = self._topic(subscription.topic, subscription.type_name)
        if qos.depth and qos.durability == "volatile":
            qos = replace(qos, depth=qos.depth + SLACK)
        reader = RawReader(self._participant, topic, qos, self._user_data(subscription.type_name))
        self._events.attach(reader.entity, (reader.entity, reader.condition), partial(subscription.service, reader))
        return reader

    def drop_reader(self, reader: RawReader) -> None:
        self._events.detach(reader.entity)
        reader.delete()

    def forget(self, endpoint: DdsSubscription | DdsPublisher) -> None:
        if self.closed:
            return
        if isinstance(endpoint, DdsSubscription):
            with self._lock:
                self._subscriptions.remove(endpoint)
            for reader in endpoint.readers():
                self.drop_reader(reader)
        else:
            with self._lock:
                self._advertised.remove(endpoint)
            self._events.detach(endpoint.writer.entity)
            endpoint.writer.delete()
        self.announce()

    def announce(self) -> None:
        with self._announcing:
            with self._lock:
                readers = [reader.guid for subscription in self._subscriptions for reader in subscription.readers()]
                writers = [publisher.writer.guid for publisher in self._advertised]
            pairs = self.pairs.nodes()
            own_readers, own_writers = pairs.pop("", ([], []))
            nodes = [ros_graph.NodeEntities(*self._node, readers + own_readers, writers + own_writers)]
            nodes += [ros_graph.NodeEntities(*_split(name), *guids) for name, guids in sorted(pairs.items())]
            info = ros_graph.participant_entities_info(self.own_guid, nodes, gid_bytes=self._gid_bytes)
            try:
                self._discovery.write(info)
            except DdsError:
                if not self.closed:
                    raise

    # The thread.

    def _run(self) -> None:
        deadline: float | None = None
        while not self.closed:
            try:
                steps = self._events.wait(None if deadline is None else max(0.0, deadline - time.monotonic()))
            except DdsError as error:
                if not self.closed:
                    _log.error("domain %d: no message will be received any more: %s", self.domain_id, error)
                return
            for step in steps:
                self._guarded(step)
            with self._lock:
                outdated = [subscription for subscription in self._subscriptions if subscription.outdated]
            deadline = None
            for subscription in outdated:
                self._guarded(partial(subscription.retire, time.monotonic()))
                if until := subscription.outdated:
                    deadline = until if deadline is None else min(deadline, until)

    def _guarded(self, step: Callable[[], object]) -> None:
        """Run a step that fails if another thread closed the endpoint after it triggered; that is a normal end."""
        try:
            step()
        except DdsError as error:
            if not self.closed and not error.gone:
                self.count("dds_failed", str(error))

    def _graph_changed(self, watch: EndpointWatch, *, publishers: bool) -> None:
        changed: set[str] = set()
        while changes := watch.take():
            changed |= self._others.change(changes, publishers=publishers)
        if self._gid_bytes == 24 and ros_graph.DISCOVERY_TOPIC in changed and self._others.has_short_gids():
            self._gid_bytes = 16
            self.announce()
        if ros_graph.DISCOVERY_TOPIC in changed:
            self.pairs.look()
        if publishers:
            with self._lock:
                affected = [s for s in self._subscriptions if ros_graph.dds_topic(s.topic) in changed]
            for subscription in affected:
                subscription.adapt(self._offers(subscription.topic, subscription.type_name))

    def _offers(self, topic: str, type_name: str) -> list[Qos]:
        """The QoS of the publishers of a topic; publishers of another type are counted and left out."""
        all_of_topic = self._others.publishers(topic)
        ours = ros_graph.dds_type(type_name)
        for other in {e.type_name for e in all_of_topic} - {ours}:
            text = f"{topic}: a publisher sends {ros_graph.ros_type(other)}, subscribed is {type_name}"
            self.count_once(f"incompatible_type:{topic}", text)
        return [e.qos for e in all_of_topic if e.type_name == ours]

    # Bookkeeping.

    def _check_open(self, what: str) -> None:
        if self.closed:
            raise MiddlewareError(f"{what}: the middleware is closed")

    def _topic(self, topic: str, type_name: str) -> Entity:
        with self._lock:
            entity = self._topics.get((topic, type_name))
            if entity is None:
                names = ros_graph.dds_topic(topic), ros_graph.dds_type(type_name)
                entity = self._topics[topic, type_name] = create_topic(self._participant, *names)
            return entity

    def _user_data(self, type_name: str) -> bytes:
        """User data of an endpoint: the type hash that other endpoints on the graph announce, otherwise that of ROS."""
        from gr_ros2.middleware.type_definitions import type_hash

        return ros_graph.endpoint_user_data(self._others.hash_of(ros_graph.dds_type(type_name)) or type_hash(type_name))


def _split(node: str) -> tuple[str, str]:
    namespace, _, name = node.rpartition("/")
    return name, namespace or "/"
