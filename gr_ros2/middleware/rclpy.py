"""A ROS graph through rclpy, for users with a sourced ROS 2 (Humble or later).

Invariants: this module and ``rclpy_executor`` are the only ones of the package that import rclpy; it has its own
context, node and executor, so a host application keeps its node, arguments and signal handlers; only the executor's
thread destroys endpoints and runs callbacks, so no callback runs after ``close`` has returned.

Adaptive subscriptions follow adapt.Adaptation; while one joins again, messages in transit may be missed, and repeated
messages of transient-local publishers are dropped.
"""

from __future__ import annotations

import atexit
import contextlib
import logging
import threading
import time
from collections.abc import Callable, Iterable
from importlib import import_module
from typing import Any

from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.exceptions import InvalidHandle, NameValidationException
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message, serialize_message

from gr_ros2.core.errors import ConfigError, MiddlewareError
from gr_ros2.middleware.adapt import Adaptation, Replays, compatible
from gr_ros2.middleware.base import (
    MessageCallback,
    Publisher,
    Qos,
    Subscription,
    TopicInfo,
    finite,
)
from gr_ros2.middleware.rcl import node_of, ros_localhost_only, translated
from gr_ros2.middleware.rclpy_executor import RclpyExecutor
from gr_ros2.middleware.rclpy_services import RclpyClient, RclpyParticipant, RclpyServer
from gr_ros2.middleware.ros_graph import check_node, check_topic, resolve_domain_id
from gr_ros2.middleware.services import (
    DESCRIPTION,
    SERVICE_QOS,
    ReplyCallback,
    RequestCallback,
    ServerCallback,
    Witness,
)
from gr_ros2.settings.fields import AUTO, Auto
from gr_ros2.settings.registry import normalize_type

try:  # its name since Iron
    from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks, UnsupportedEventTypeError
except ImportError:  # Humble
    from rclpy.qos_event import PublisherEventCallbacks, SubscriptionEventCallbacks, UnsupportedEventTypeError

_log = logging.getLogger(__name__)

ENCAPSULATION = 4
"""Bytes of the encapsulation header of a serialized message."""


def message_class(type_name: str) -> Any:
    """The Python class of ``package/msg/Type`` (or ``package/Type``, or an action's feedback), its C type support
    loaded.

    :raises ConfigError: malformed, or not in the sourced workspaces
    """
    package, folder, name = normalize_type(type_name).split("/")
    try:
        module = import_module(f"{package}.{folder}")
        if folder == "action":
            kind = getattr(module, name.removesuffix("_FeedbackMessage")).Impl.FeedbackMessage
        else:
            kind = getattr(module, name)
        if kind.__class__._TYPE_SUPPORT is None:
            kind.__class__.__import_type_support__()
    # The import runs generated code and loads C libraries, which may raise other errors than ImportError.
    except Exception as error:
        raise ConfigError(
            f"type {package}/{folder}/{name} cannot be imported ({error}); source the workspace that has it "
            f"(. install/setup.bash) before starting, or use middleware 'dds', which needs no definitions"
        ) from error
    return kind


def _to_profile(qos: Qos) -> QoSProfile:
    """The rclpy profile. None of a publisher means the default of base.Qos; a subscription has no None here."""
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST if qos.depth else HistoryPolicy.KEEP_ALL,
        depth=qos.depth,
        reliability=ReliabilityPolicy.BEST_EFFORT if qos.reliability == "best_effort" else ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL
        if qos.durability == "transient_local"
        else DurabilityPolicy.VOLATILE,
        lifespan=Duration(nanoseconds=int(qos.lifespan_s * 1e9)),  # 0: not specified, which means no limit
        deadline=Duration(nanoseconds=int(qos.deadline_s * 1e9)),
    )


def _policies(profile: Any) -> tuple[object, object]:
    return profile.reliability, profile.durability


def _from_profile(profile: Any) -> Qos:
    """The Qos of a profile. Some RMWs do not announce the history; the depth is then the default."""
    if profile.history == HistoryPolicy.KEEP_LAST:
        depth = int(profile.depth)
    else:
        depth = 0 if profile.history == HistoryPolicy.KEEP_ALL else Qos().depth
    return Qos(
        "reliable" if profile.reliability == ReliabilityPolicy.RELIABLE else "best_effort",
        "transient_local" if profile.durability == DurabilityPolicy.TRANSIENT_LOCAL else "volatile",
        depth,
        finite(profile.lifespan.nanoseconds * 1e-9),
        finite(profile.deadline.nanoseconds * 1e-9),
    )


def _policy_name(event: Any) -> str:
    """``reliability``, ``durability``, … of an incompatible-QoS event."""
    try:
        return str(QoSPolicyKind(event.last_policy_kind).name).lower()
    except ValueError:
        return str(event.last_policy_kind)


class RclpyMiddleware(RclpyParticipant):
    """One ROS 2 node in a context of its own, spinning in a thread of its own.

    ``counters`` also has ``executor_failed``: errors of rclpy itself, for instance a message that it could not take. A
    topic or service whose type cannot be imported, or whose name ROS does not allow, is a ConfigError.

    :param domain_id: 0..232; auto takes ROS_DOMAIN_ID
    :param node_name: base name of the node
    :param namespace: its namespace
    :param localhost_only: in place of ROS_LOCALHOST_ONLY, unless auto
    :raises ConfigError: for a domain id or name ROS does not allow
    :raises MiddlewareError: when ROS cannot start, e.g. no RMW installed
    """

    name = "rclpy"
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
        self.domain_id = domain_id = resolve_domain_id(domain_id)
        node_name, namespace = check_node(node_name, namespace)
        self._context = Context()
        try:
            # Context.init does not touch signal handlers, unlike rclpy.init; without args=[] it would parse the command
            # line.
            with ros_localhost_only(localhost_only):
                self._context.init(args=[], domain_id=domain_id)
            self._node = Node(
                node_name,
                context=self._context,
                namespace=namespace,
                use_global_arguments=False,
                enable_rosout=False,
                start_parameter_services=False,
            )
        except (RuntimeError, NameValidationException) as error:
            self._context.try_shutdown()
            raise MiddlewareError(f"rclpy cannot start a node on domain {domain_id}: {error}") from error
        self._subscriptions: list[_RclpySubscription] = []
        self._clients: list[RclpyClient] = []
        self._shown: dict[str, tuple[Any, list[Any]]] = {}
        """Nodes of other robots that are shown here, and the services of each."""
        self._showing = threading.Lock()
        self._executor = RclpyExecutor(self._context, self._node, tend=self._tend, leave=self._leave, count=self.count)
        atexit.register(self.close)  # a daemon thread inside rcl must not outlive the interpreter

    def subscribe(self, topic: str, type_name: str, qos: Qos, callback: MessageCallback) -> Subscription:
        self.check_open()
        subscription = _RclpySubscription(self, topic, type_name, qos, callback)
        subscription.adapt()
        self._subscriptions.append(subscription)
        return subscription

    def advertise(self, topic: str, type_name: str, qos: Qos) -> Publisher:
        self.check_open()
        return _RclpyPublisher(self, topic, type_name, qos)

    def serve(self, service: str, type_name: str, on_request: RequestCallback, node: str = "") -> RclpyServer:
        self.check_open()
        return RclpyServer(self, check_topic(service), type_name, on_request, node)

    def client(self, service: str, type_name: str, on_reply: ReplyCallback, on_server: ServerCallback) -> RclpyClient:
        self.check_open()
        client = RclpyClient(self, check_topic(service), type_name, on_reply, on_server)
        self._clients.append(client)
        return client

    def discover(self) -> list[TopicInfo]:
        """The topics of others. One with several types has a row per type; depths are known only where the RMW
        announces them."""
        self.check_open()
        node = self._node
        found = []
        with translated("the graph cannot be read"):
            for topic, type_names in node.get_topic_names_and_types():
                publishers = self._foreign(node.get_publishers_info_by_topic(topic), topic, node.publishers)
                subscribers = self._foreign(node.get_subscriptions_info_by_topic(topic), topic, node.subscriptions)
                for type_name in type_names:
                    offers = tuple(_from_profile(i.qos_profile) for i in publishers if i.topic_type == type_name)
                    requests = tuple(_from_profile(i.qos_profile) for i in subscribers if i.topic_type == type_name)
                    if offers or requests:
                        found.append(TopicInfo(topic, type_name, offers, requests))
        return sorted(found, key=lambda info: (info.topic, info.type_name))

    def discover_services(self) -> dict[str, str]:
        """Name and type of each service. ROS tells no servers from clients. Of several types the first is taken."""
        self.check_open()
        nodes = [self._node, *(node for node, _ in tuple(self._shown.values()))]
        own = {service.srv_name for node in nodes for service in node.services}
        with translated("the graph cannot be read"):
            found = self._node.get_service_names_and_types()
        return {name: type_names[0] for name, type_names in found if type_names and name not in own}

    def witnesses(self, topic: str, type_name: str) -> list[Witness]:
        """Who can describe a type. rclpy gives type hashes since Jazzy."""
        self.check_open()
        node = self._node
        with translated(f"endpoints of {topic} cannot be read"):
            infos = [
                *self._foreign(node.get_publishers_info_by_topic(topic), topic, node.publishers),
                *self._foreign(node.get_subscriptions_info_by_topic(topic), topic, node.subscriptions),
            ]
        found: dict[str, set[str]] = {}
        for info in infos:
            digest, owner = getattr(info, "topic_type_hash", None), node_of(info)
            if info.topic_type == type_name and digest is not None and digest.version > 0:
                found.setdefault(str(digest), set()).update({f"{owner}/{DESCRIPTION}"} if owner else ())
        return [Witness(digest, tuple(sorted(services))) for digest, services in sorted(found.items())]

    def close(self) -> None:
        """Leave the graph; waits ``JOIN_S`` for a callback that is running, unless called from it."""
        atexit.unregister(self.close)
        self._executor.close()
        self.wait_for_thread(self._executor.thread)

    # For our endpoints

    @property
    def closing(self) -> bool:
        """Whether the middleware is closing; no callback starts then."""
        return self._executor.closing

    def check_open(self) -> None:
        """:raises MiddlewareError: closed, or its context was shut down from outside"""
        if not self._executor.open:
            raise MiddlewareError("rclpy: the middleware is closed")

    def publishers_of(self, topic: str, type_name: str) -> dict[bytes, Qos]:
        """The QoS of the publishers of a topic and type, this node's included, by their ids; publishers of other types
        are counted."""
        with translated(f"publishers of {topic} cannot be read"):
            infos = self._node.get_publishers_info_by_topic(topic)
        strangers = {i.topic_type for i in infos} - {type_name}
        if strangers:
            text = f"{topic}: a publisher sends {', '.join(sorted(strangers))}, subscribed is {type_name}"
            self.count_once(f"incompatible_type:{topic}", text)
        return {bytes(i.endpoint_gid): _from_profile(i.qos_profile) for i in infos if i.topic_type == type_name}

    def create(self, kind: str, events: type, handlers: dict[str, Callable[[Any], None]], **arguments: Any) -> Any:
        """Make an endpoint with the event callbacks that this RMW supports."""
        make = getattr(self._node, f"create_{kind}")
        names = list(handlers)
        while True:
            supported = events(use_default_callbacks=False, **{name: handlers[name] for name in names})
            try:
                return make(event_callbacks=supported, callback_group=self._executor.group, **arguments)
            except UnsupportedEventTypeError:
                if not names:
                    raise
                _log.info("%s: this RMW does not report %s", arguments["topic"], names.pop())
            except (RuntimeError, NameValidationException) as error:
                raise MiddlewareError(f"{kind} of {arguments['topic']} failed: {error}") from error

    def make(self, kind: str, service_type: Any, name: str, *callback: Callable[..., Any], node: str = "") -> Any:
        """Make a service or a client.

        :param node: absolute name of the node that has it; '' for the participant's own
        """
        with self._showing:
            try:
                owner = self._shown_node(node) if node else self._node
                make = getattr(owner, f"create_{kind}")
                endpoint = make(
                    service_type,
                    name,
                    *callback,
                    qos_profile=_to_profile(SERVICE_QOS),
                    callback_group=self._executor.group,
                )
            except (RuntimeError, NameValidationException) as error:
                raise MiddlewareError(f"{kind} of {name} failed: {error}") from error
            if node:
                self._shown[node][1].append(endpoint)
        return endpoint

    def to_bytes(self, message: Any) -> bytes:
        return bytes(serialize_message(message))

    def to_message(self, payload: bytes, message_type: Any) -> Any:
        return deserialize_message(payload, message_type)

    def destroy(self, kind: str, endpoint: Any) -> None:
        """Destroy an endpoint, in the executor's thread."""
        self._clients = [client for client in self._clients if not client.is_of(endpoint)]
        with self._showing, contextlib.suppress(InvalidHandle):  # destroyed with its node already
            for name, (node, endpoints) in tuple(self._shown.items()):
                if endpoint in endpoints:
                    node.destroy_service(endpoint)
                    endpoints.remove(endpoint)
                    if not endpoints:
                        del self._shown[name]
                        self._executor.remove(node)
                        node.destroy_node()
                    return
            getattr(self._node, f"destroy_{kind}")(endpoint)

    def in_executor(self, work: Callable[[], None]) -> None:
        self._executor.run(work)

    def forget(self, subscription: _RclpySubscription) -> None:
        """Stop adapting a subscription."""
        with contextlib.suppress(ValueError):
            self._subscriptions.remove(subscription)

    # Internals

    def _shown_node(self, name: str) -> Any:
        """The node of that absolute name: ros2 param and ros2 lifecycle look for a node before they call its
        services."""
        if name not in self._shown:
            namespace, _, base = name.rpartition("/")
            node = Node(
                base,
                context=self._context,
                namespace=namespace or "/",
                use_global_arguments=False,
                enable_rosout=False,
                start_parameter_services=False,
                parameter_overrides=[Parameter("start_type_description_service", value=False)],
            )
            self._executor.add(node)
            self._shown[name] = (node, [])
        return self._shown[name][0]

    def _foreign(self, infos: Iterable[Any], topic: str, own_endpoints: Iterable[Any]) -> list[Any]:
        """The endpoints of other nodes. Another node may have the same name; so from the endpoints with this node's
        name, as many are removed as this node has."""
        name = self._node.get_name(), self._node.get_namespace()
        others = [i for i in infos if node_of(i) not in self._shown]
        for endpoint in own_endpoints:
            if endpoint.topic != topic:
                continue
            own = (*name, *_policies(endpoint.qos_profile))
            for info in others:
                if (info.node_name, info.node_namespace, *_policies(info.qos_profile)) == own:
                    others.remove(info)
                    break
        return others

    def _tend(self, failed: bool) -> None:
        """In the executor's thread: adapt subscriptions, and join again those that may have failed."""
        for subscription in tuple(self._subscriptions):
            if failed:
                subscription.revive()
            subscription.adapt()
        for client in tuple(self._clients):
            client.look()

    def _leave(self) -> None:
        """In the executor's thread, at its end."""
        for node, _ in self._shown.values():
            node.destroy_node()
        self._node.destroy_node()
        self._context.try_shutdown()


class _RclpySubscription(Subscription):
    """Adapted and destroyed in the executor's thread after ``subscribe`` has returned.

    ``calling`` is held while it adapts: the first join is in the caller's thread, with the executor's already at work.
    """

    def __init__(
        self, middleware: RclpyMiddleware, topic: str, type_name: str, qos: Qos, callback: MessageCallback
    ) -> None:
        super().__init__()
        self._middleware = middleware
        self._topic = check_topic(topic)
        self._type_name = normalize_type(type_name)
        self._class = message_class(type_name)
        self._callback = callback
        self._adaptation = Adaptation(qos)
        self._replays = Replays()
        self._endpoint: Any = None
        self._closed = False

    def adapt(self) -> None:
        """Join the graph, or join it again, where the publishers require it."""
        with self.calling:
            if not self._closed:
                publishers = self._middleware.publishers_of(self._topic, self._type_name)
                self.found(list(publishers.values()))
                qos = self._adaptation.consider(publishers)
                if qos is not None:
                    _log.info("%s: joining as %s, %s", self._topic, qos.reliability, qos.durability)
                    self._join()

    def revive(self) -> None:
        """Join again after rclpy failed to take a message (for instance an empty one), because it then never receives
        on that endpoint again."""
        if self._endpoint is not None and not self._closed and getattr(self._endpoint, "_executor_event", True):
            self._join()

    def _join(self) -> None:
        self._leave()
        assert self._adaptation.settled is not None
        self._replays.join(self._adaptation.settled, time.monotonic())
        self._endpoint = self._middleware.create(
            "subscription",
            SubscriptionEventCallbacks,
            {"incompatible_qos": self._on_incompatible, "message_lost": self._on_lost},
            msg_type=self._class,
            topic=self._topic,
            callback=self._deliver,
            qos_profile=_to_profile(self._adaptation.settled),
            raw=True,
        )

    def _leave(self) -> None:
        endpoint, self._endpoint = self._endpoint, None
        if endpoint is not None:
            self._middleware.destroy("subscription", endpoint)

    def matched(self) -> int:
        endpoint, qos = self._endpoint, self._adaptation.settled
        if endpoint is None or qos is None or self._closed or self._middleware.closing:
            return 0
        with translated(f"{self._topic} is closed"):
            if hasattr(endpoint, "get_publisher_count"):  # since Jazzy
                return int(endpoint.get_publisher_count())
            offers = self._middleware.publishers_of(self._topic, self._type_name).values()
            return sum(compatible(offer, qos) for offer in offers)

    def close(self) -> None:
        if not self._closed:
            self._closed = True
            self._middleware.forget(self)
            self._middleware.in_executor(self._leave)

    def _deliver(self, payload: bytes) -> None:
        latched = any(offer.durability == "transient_local" for offer in self._offers)
        if self._closed or self._middleware.closing or (latched and self._replays.has(payload, time.monotonic())):
            return
        self._middleware.deliver(self._topic, self._callback, payload)

    def _on_incompatible(self, event: Any) -> None:
        policy = _policy_name(event)
        if self._adaptation.adapts(policy):  # the next adaptation corrects this
            self.adapt()
            return
        self._middleware.count(
            f"incompatible_qos:{self._topic}:{policy}",
            f"{self._topic}: a publisher does not offer the {policy} this subscription requests; no messages from it",
            event.total_count_change,
        )

    def _on_lost(self, event: Any) -> None:
        text = f"{self._topic}: the RMW lost messages"
        self._middleware.count_lost(self, self._topic, text, event.total_count_change)


class _RclpyPublisher(Publisher):
    def __init__(self, middleware: RclpyMiddleware, topic: str, type_name: str, qos: Qos) -> None:
        self._middleware = middleware
        self._topic = check_topic(topic)
        self._closed = False
        self._endpoint: Any = middleware.create(
            "publisher",
            PublisherEventCallbacks,
            {"incompatible_qos": self._on_incompatible},
            msg_type=message_class(type_name),
            topic=topic,
            qos_profile=_to_profile(qos),
        )

    def publish(self, payload: bytes) -> None:
        if self._closed:
            raise MiddlewareError(f"{self._topic}: the publisher is closed")
        self._middleware.check_open()
        if len(payload) < ENCAPSULATION:  # an empty message makes rclpy's subscribers stop receiving
            raise MiddlewareError(f"{self._topic}: {len(payload)} bytes are not a serialized message")
        with translated(f"{self._topic}: publishing {len(payload)} bytes failed"):
            self._endpoint.publish(payload)

    def matched(self) -> int:
        if self._closed or self._middleware.closing:
            return 0
        with translated(f"{self._topic} is closed"):
            return int(self._endpoint.get_subscription_count())

    def close(self) -> None:
        if not self._closed:
            self._closed = True
            self._middleware.in_executor(lambda: self._middleware.destroy("publisher", self._endpoint))

    def _on_incompatible(self, event: Any) -> None:
        policy = _policy_name(event)
        self._middleware.count(
            f"incompatible_qos:{self._topic}:{policy}",
            f"{self._topic}: a subscriber requests another {policy} than this publisher offers; it gets no messages",
            event.total_count_change,
        )
