"""A ROS graph inside one process, for tests that do not need a DDS.

Invariants: participants with the same domain id share a graph and behave as DDS has it: history depth, late joiners of
transient-local publishers, requested against offered QoS; each participant calls back from one thread of its own,
in the order of publication. Unlike a DDS it counts every message that is dropped because of a subscription's depth.
"""

from __future__ import annotations

import threading
from collections import deque
from weakref import WeakValueDictionary

from gr_ros2.core.errors import MiddlewareError
from gr_ros2.middleware import ros_graph
from gr_ros2.middleware.adapt import offered, refused_policies
from gr_ros2.middleware.base import MessageCallback, Publisher, Qos, TopicInfo, grouped
from gr_ros2.middleware.delivery import CallbackThread, QueuedSubscription
from gr_ros2.middleware.memory_services import MemoryClient, MemoryServer, MemoryServices
from gr_ros2.middleware.services import ReplyCallback, RequestCallback, ServerCallback, ServiceGraph
from gr_ros2.settings.fields import Auto
from gr_ros2.settings.registry import normalize_type


class _Graph:
    """State shared by the participants of one domain. Every method is called with ``lock`` held."""

    def __init__(self) -> None:
        self.lock = threading.RLock()
        self.publishers: list[MemoryPublisher] = []
        self.subscriptions: list[MemorySubscription] = []
        self.services = MemoryServices(self.lock)

    def endpoints(self) -> list[MemoryPublisher | MemorySubscription]:
        return [*self.publishers, *self.subscriptions]

    def joined(self, publisher: MemoryPublisher, subscription: MemorySubscription) -> None:
        """A publisher and a subscription see each other for the first time."""
        if publisher.topic != subscription.topic:
            return
        if publisher.type_name != subscription.type_name:
            text = f"{publisher.topic}: published as {publisher.type_name}, subscribed as {subscription.type_name}"
            for middleware in {publisher.middleware, subscription.middleware}:
                middleware.count(f"incompatible_type:{publisher.topic}", text)
            return
        refused = refused_policies(publisher.qos, subscription.qos)
        for policy in refused:
            text = f"{publisher.topic}: the {policy} of publisher and subscription is incompatible"
            for middleware in {publisher.middleware, subscription.middleware}:
                middleware.count(f"incompatible_qos:{publisher.topic}:{policy}", text)
        if not refused:
            publisher.matches.append(subscription)
            subscription.matches[publisher] = publisher.published
            subscription.look()

    def left(self, endpoint: MemoryPublisher | MemorySubscription) -> None:
        if isinstance(endpoint, MemoryPublisher):
            self.publishers.remove(endpoint)
            for subscription in endpoint.matches:
                subscription.matches.pop(endpoint, None)
                subscription.look()
                self.replay(subscription)
        else:
            self.subscriptions.remove(endpoint)
            for publisher in endpoint.matches:
                publisher.matches.remove(endpoint)
        endpoint.matches.clear()

    def replay(self, subscription: MemorySubscription) -> None:
        """Deliver messages published before the match, where all publishers are transient-local."""
        wanted = subscription.qos.durability
        latched = all(publisher.qos.durability == "transient_local" for publisher in subscription.matches)
        if wanted == "transient_local" or (wanted is None and latched):
            for publisher, matched_at in subscription.matches.items():
                for serial, payload in publisher.history:
                    if serial < matched_at:
                        subscription.push(payload, id(publisher))
                subscription.matches[publisher] = 0


_graphs: WeakValueDictionary[int, _Graph] = WeakValueDictionary()
"""Graphs in use; a graph without participants is deleted."""
_graphs_lock = threading.Lock()


class MemoryPublisher(Publisher):
    """Hands messages to the subscriptions of its domain."""

    def __init__(self, middleware: MemoryMiddleware, topic: str, type_name: str, qos: Qos) -> None:
        self.middleware = middleware
        self.topic = topic
        self.type_name = type_name
        self.qos = qos
        self.matches: list[MemorySubscription] = []
        self.published = 0
        latched = qos.durability == "transient_local"
        self.history: deque[tuple[int, bytes]] = deque(maxlen=(qos.depth or None) if latched else 0)
        self.closed = False

    def publish(self, payload: bytes) -> None:
        """Deliver a message to every matched subscription; never blocks.

        :raises MiddlewareError: once closed
        """
        payload = bytes(payload)
        with self.middleware.graph.lock:
            if self.closed:
                raise MiddlewareError(f"publish on {self.topic}: the publisher is closed")
            self.history.append((self.published, payload))
            self.published += 1
            for subscription in self.matches:
                subscription.push(payload, id(self))

    def matched(self) -> int:
        return len(self.matches)

    def close(self) -> None:
        with self.middleware.graph.lock:
            if not self.closed:
                self.closed = True
                self.middleware.graph.left(self)


class MemorySubscription(QueuedSubscription):
    """A queue that publishers of its domain fill."""

    def __init__(
        self, middleware: MemoryMiddleware, topic: str, type_name: str, qos: Qos, callback: MessageCallback
    ) -> None:
        super().__init__(middleware, middleware.thread, topic, qos.depth, callback)
        self.middleware = middleware
        self.type_name = type_name
        self.qos = qos
        self.matches: dict[MemoryPublisher, int] = {}  # earlier messages that are still to be replayed

    def offers(self) -> list[Qos]:
        with self.middleware.graph.lock:
            return [publisher.qos for publisher in self.matches]

    def matched(self) -> int:
        return len(self.matches)

    def leave(self) -> None:
        graph = self.middleware.graph
        with graph.lock:
            if self in graph.subscriptions:  # otherwise the participant has just left, with all its endpoints
                graph.left(self)


class MemoryMiddleware(ServiceGraph):
    """A participant of a graph in this process.

    :param domain_id: 0..232, auto takes ROS_DOMAIN_ID; participants of equal domain share a graph
    :param node_name: checked, otherwise unused; likewise the namespace
    :raises ConfigError: a name or number is malformed
    """

    name = "memory"

    def __init__(self, *, domain_id: int | Auto = 0, node_name: str = "gr_ros2", namespace: str = "/") -> None:
        super().__init__()
        self.domain_id: int = ros_graph.resolve_domain_id(domain_id)
        ros_graph.check_node(node_name, namespace)
        with _graphs_lock:
            self.graph = _graphs.setdefault(self.domain_id, _Graph())
        self.closed = False
        self.thread = CallbackThread(self, node_name)

    def subscribe(self, topic: str, type_name: str, qos: Qos, callback: MessageCallback) -> MemorySubscription:
        topic, type_name = ros_graph.check_topic(topic), normalize_type(type_name)
        subscription = MemorySubscription(self, topic, type_name, qos, callback)
        with self.graph.lock:
            self._check_open(f"subscribe {topic}")
            self.graph.subscriptions.append(subscription)
            for publisher in self.graph.publishers:
                self.graph.joined(publisher, subscription)
            self.graph.replay(subscription)
        return subscription

    def advertise(self, topic: str, type_name: str, qos: Qos) -> MemoryPublisher:
        topic, type_name = ros_graph.check_topic(topic), normalize_type(type_name)
        publisher = MemoryPublisher(self, topic, type_name, offered(qos))
        with self.graph.lock:
            self._check_open(f"advertise {topic}")
            self.graph.publishers.append(publisher)
            for subscription in self.graph.subscriptions:
                self.graph.joined(publisher, subscription)
                self.graph.replay(subscription)
        return publisher

    def serve(
        self,
        service: str,
        type_name: str,
        on_request: RequestCallback,
        node: str = "",  # noqa: ARG002 - nobody asks for nodes here
    ) -> MemoryServer:
        names = ros_graph.check_topic(service), type_name
        with self.graph.lock:
            self._check_open(f"serve {service}")
            return MemoryServer(self.graph.services, self, self.thread, names, on_request)

    def client(self, service: str, type_name: str, on_reply: ReplyCallback, on_server: ServerCallback) -> MemoryClient:
        names = ros_graph.check_topic(service), type_name
        with self.graph.lock:
            self._check_open(f"call {service}")
            return MemoryClient(self.graph.services, self, self.thread, names, (on_reply, on_server))

    def discover(self) -> list[TopicInfo]:
        with self.graph.lock:
            found = [
                [(end.topic, end.type_name, end.qos) for end in ends if end.middleware is not self]
                for ends in (self.graph.publishers, self.graph.subscriptions)
            ]
        return grouped(*found)

    def discover_services(self) -> dict[str, str]:
        with self.graph.lock:
            return dict(server.names for server in self.graph.services.servers if server.participant is not self)

    def close(self) -> None:
        with self.graph.lock:
            if self.closed:
                return
            self.closed = True
            for endpoint in self.graph.endpoints():
                if endpoint.middleware is self:
                    endpoint.closed = True
                    self.graph.left(endpoint)
            self.graph.services.left(self)
        self.thread.close()

    def _check_open(self, what: str) -> None:
        if self.closed:
            raise MiddlewareError(f"{what}: the middleware is closed")
