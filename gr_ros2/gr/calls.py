"""Services across the link, between two ROS graphs and the engine of calls.

A service of this robot is announced while a server for it is on the source's graph, and no longer. A service that
another robot announces gets a server of ours on the sink's graph, for exactly as long as the robot announces it and is
heard. So a client here finds a server only while there is one over there. The link itself is called too: it is asked
for topics (:mod:`gr_ros2.gr.wishes`).

Invariants: this class is a thin shell; the engine (:mod:`gr_ros2.calls`) decides, and the lock of the endpoint protects
it; no endpoint on a graph is made, closed or written to while that lock is held.
"""

from __future__ import annotations

import logging
import threading
from collections import Counter
from collections.abc import Callable, Hashable, Sequence
from concurrent.futures import Future
from concurrent.futures import TimeoutError as FutureTimeoutError
from dataclasses import dataclass
from functools import partial
from typing import Any

from gr_ros2.calls import NO_DEADLINE, Answer, Calls, Offer, OutgoingFrame, Request, Service
from gr_ros2.calls.frames import OF_LINK
from gr_ros2.core.errors import ConfigError, GrRos2Error, MiddlewareError, WireError
from gr_ros2.gr.found_topics import FoundTopics
from gr_ros2.gr.live_end import LiveEnd
from gr_ros2.gr.loops import LOOP_GUARD
from gr_ros2.gr.receiving import ReceivingBlock
from gr_ros2.gr.sending import SendingBlock
from gr_ros2.link import Delivered, ReceiverEvent
from gr_ros2.link.endpoint import OpenEndpoint
from gr_ros2.link.events import Gone, Met
from gr_ros2.middleware import Middleware
from gr_ros2.middleware.services import ServiceClient, ServiceGraph, ServiceServer
from gr_ros2.settings.fields import AUTO
from gr_ros2.settings.registry import CALLS_TYPE, FILLER_TYPE, INTERNAL_TYPES, MAX_TOPICS, Registry, Topic

DEADLINE_S = 30.0
"""s that a call waits for its reply, unless ``deadline_s`` of its service says otherwise."""
_NEVER_LATE = "_action/get_result"
"""End of the name of a service that replies when its action has ended."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class _Robot:
    """A robot that is heard: its start, and the services that it has announced."""

    boot: int
    services: dict[int, Topic]
    here: bool = True


class LiveCalls:
    """The services of both directions of one robot's link.

    :param end: the endpoint, whose registry has a topic for requests and replies behind those of the source
    :param source, sink: the blocks whose graphs are joined
    :param found: what is looked for on the graph
    :raises ConfigError: for a service on a graph that carries topics only
    """

    def __init__(
        self, end: LiveEnd[OpenEndpoint], source: SendingBlock, sink: ReceivingBlock, found: FoundTopics
    ) -> None:
        self._end, self._messages = end.endpoint, end.endpoint.messages
        self._lock, self._rouse = end.lock, end.rouse
        self._engine = Calls(source.src_id, self._end.boot)
        self._topic_id = len(source.subscriptions.registry)
        self._source, self._sink = source, sink
        self._clock = source.clock
        self._robots: dict[int, _Robot] = {}
        self._servers: dict[tuple[int, int], ServiceServer] = {}
        self._counters: Counter[str] = Counter()
        self._changing = threading.Lock()  # for the servers; held while they are made and closed
        self._closed = False
        self._own: dict[int, Offer] = {}
        """The services of this robot by id."""
        self._offered: dict[int, Offer] = {OF_LINK: Offer("this link", DEADLINE_S)}
        """The services of this robot whose server is there, by id, and its link."""
        self.on_link_call: Callable[[int, int, Request], None] = lambda _robot, _boot, _request: None
        """Called when another robot, of this start, calls the link itself; must return at once."""
        self.link_calls: dict[int, Callable[[int, int, Request], None]] = {}
        """The same for calls that begin with this byte; raises WireError for one that cannot be read."""
        self.on_filler: Callable[[int, bytes], None] = lambda _robot, _payload: None
        """Called with a message of a measurement (:mod:`gr_ros2.gr.throughput`); must return at once."""
        self.on_met: Callable[[int, int], None] = lambda _robot, _boot: None
        """Called when a robot of this start is heard for the first time or again; must return at once."""
        self._clients: dict[int, ServiceClient] = {}
        for name, topic in source.subscriptions.services.items():
            self._offer(name, topic)
        found.offer_with(partial(self._offer, found=True), self._withdraw)
        sink.share(self)

    def takes(self, event: ReceiverEvent) -> bool:
        if isinstance(event, Met):
            self._met(event)
        elif isinstance(event, Gone):
            self._change(event.src_id, here=False)
        elif isinstance(event, Delivered):
            type_name = self._type_of(event)
            if type_name == CALLS_TYPE:
                self._receive(event)
            elif type_name == FILLER_TYPE:
                self.on_filler(event.src_id, event.payload)
            return type_name in INTERNAL_TYPES
        return False

    def learn(self, src_id: int, topics: Sequence[Topic]) -> None:
        services = {topic.topic_id: topic for topic in topics if topic.is_service}
        robot = self._robots.get(src_id)
        if robot is None:
            return
        lost = robot.services.keys() - services.keys()
        with self._lock:
            self._engine.withdrawn(src_id, lost)
        self._change(src_id, services=services)
        feedback = [topic.topic_id for topic in topics if topic.is_topic and "/_action/" in topic.name]
        if feedback and services:
            self._sink.outputs.announce(src_id, feedback)

    def stats(self) -> dict[str, Any]:
        """A snapshot: counters of :class:`gr_ros2.calls.Calls` and of this class, and the calls that wait."""
        with self._lock:
            self._engine.expire(self._clock())
            made, served = self._engine.waiting
            counters = self._engine.counters + self._counters
            refused = {why: n for (topic_id, why), n in self._end.sent.refused.items() if topic_id == self._topic_id}
            offered = sorted(offer.name for number, offer in self._offered.items() if number != OF_LINK)
        with self._changing:
            proxies = sorted(
                self._name(src_id, self._robots[src_id].services[number]) for src_id, number in self._servers
            )
        state = {"waiting": made, "serving": served, "offered": offered, "reached": proxies, "not_sent": refused}
        return {**state, "counters": dict(counters)}

    def close(self) -> None:
        """Leave the graphs. Idempotent."""
        with self._changing:
            self._closed = True
            ends: list[ServiceServer | ServiceClient] = [*self._servers.values(), *self._clients.values()]
            self._servers.clear()
        for end in ends:
            end.close()

    # ---- services of this robot

    def _offer(self, name: str, topic: Topic, *, found: bool = False) -> None:
        """Offer a service to other robots, for as long as its server is there.

        :param found: it was found on the graph; nobody has named it
        :raises ConfigError: for a service that this graph cannot have
        """
        if found and not self._source.config.key and not self._own:
            _log.warning(
                "service %s and others can be called by whoever can send on this link, as it has no key; set key, "
                "or services: false",
                name,
            )
        graph = _with_services(self._source.middleware, name)
        self._own[topic.topic_id] = Offer(name, _deadline(topic))
        changed = partial(self._server_changed, topic.topic_id)
        client = graph.client(name, topic.type_name, self._reply, changed)
        with self._changing:
            if not self._closed:
                self._clients[topic.topic_id] = client
                return
        client.close()

    def _withdraw(self, name: str) -> None:
        """Offer a service no more."""
        for topic_id in [number for number, offer in self._own.items() if offer.name == name]:
            with self._changing:
                client = self._clients.pop(topic_id, None)
            if client is not None:
                client.close()
                self._server_changed(topic_id, False)

    def _server_changed(self, topic_id: int, there: bool) -> None:
        with self._lock:
            if there:
                self._offered[topic_id] = self._own[topic_id]
                self._messages.offer(self._topic_id, offered=True)
            else:
                self._offered.pop(topic_id, None)
            self._messages.offer(topic_id, offered=there)
            self._rouse()
        _log.info("service %s: %s", self._own[topic_id].name, "offered to other robots" if there else "no server")

    def _reply(self, ticket: int, payload: bytes) -> None:
        with self._lock:
            now = self._clock()
            self._send(self._engine.reply(ticket, payload, now), now)

    # ---- services of other robots

    def _met(self, event: Met) -> None:
        with self._lock:
            self._engine.started(event.src_id, event.boot)
        known = self._robots.get(event.src_id)
        if known is None or known.boot != event.boot:
            self._change(event.src_id, services={})
            with self._changing:
                self._robots[event.src_id] = _Robot(event.boot, {})
        else:
            self._change(event.src_id, here=True)
        self.on_met(event.src_id, event.boot)

    # ---- calls of this process

    def reached(self) -> dict[str, str]:
        return {name: topic.type_name for name, _, topic in self._reached()}

    def call(self, name: str, payload: bytes) -> bytes:
        """Call a service of another robot, and wait for the reply.

        :param name: as in ``reached``
        :raises MiddlewareError: there is none, or no reply has come in time
        """
        found = next(((src_id, topic) for known, src_id, topic in self._reached() if known == name), None)
        if found is None:
            raise MiddlewareError(f"service {name}: it is not there any more")
        src_id, topic = found
        deadline_s = _deadline(topic) or DEADLINE_S
        reply: Future[bytes] = Future()
        self._request(src_id, topic, reply.set_result, payload)
        try:
            return reply.result(deadline_s)
        except FutureTimeoutError:
            raise MiddlewareError(f"service {name}: no reply within {deadline_s:g} s") from None

    def _reached(self) -> list[tuple[str, int, Topic]]:
        """The services that can be called: name here, robot and topic."""
        with self._changing:
            topics = [(src_id, self._robots[src_id].services[number]) for src_id, number in self._servers]
            return [(self._name(src_id, topic), src_id, topic) for src_id, topic in topics]

    # ---- the link itself

    def ask(self, robot: int, payload: bytes, take: Callable[[bytes], None], deadline_s: float) -> bool:
        """Call the link of another robot; returns whether that robot is heard.

        :param take: called with the reply, if one comes in time; must return at once
        """
        with self._changing:
            known = self._robots.get(robot)
        if known is None or not known.here:
            return False
        with self._lock:
            now = self._clock()
            self._messages.offer(self._topic_id, offered=True)
            service = Service(robot, known.boot, OF_LINK, f"link of robot {robot}")
            self._send(self._engine.call(service, take, payload, deadline_s=deadline_s, now=now), now)
        return True

    def answer(self, ticket: int, payload: bytes) -> None:
        """Answer a call of this link."""
        with self._lock:
            self._messages.offer(self._topic_id, offered=True)
        self._reply(ticket, payload)

    def heard(self) -> list[int]:
        """The robots that are heard."""
        with self._changing:
            return sorted(number for number, robot in self._robots.items() if robot.here)

    def check_heard(self, robot: int) -> None:
        """Check that a robot can be asked.

        :raises ConfigError: it is not heard
        """
        heard = self.heard()
        if robot not in heard:
            those = f"heard are {', '.join(map(str, heard))}" if heard else "nobody is heard"
            raise ConfigError(f"robot {robot} is not heard; {those}")

    def _change(self, src_id: int, *, services: dict[int, Topic] | None = None, here: bool | None = None) -> None:
        """Make and close servers after a robot was heard, has become silent, or has announced other services."""
        with self._changing:
            robot = self._robots.get(src_id)
            if robot is None or self._closed:
                return
            services = robot.services if services is None else services
            here = robot.here if here is None else here
            closing = []
            for key in [key for key in self._servers if key[0] == src_id]:
                same = services.get(key[1]) == robot.services.get(key[1])
                if not here or not same:
                    closing.append(self._servers.pop(key))
            self._robots[src_id] = _Robot(robot.boot, services, here)
            for server in closing:
                server.close()
            if here:
                for topic in services.values():
                    if (src_id, topic.topic_id) not in self._servers:
                        self._serve(src_id, topic)
                if services:
                    with self._lock:
                        self._messages.offer(self._topic_id, offered=True)

    def _serve(self, src_id: int, topic: Topic) -> None:
        """Make a server of ours for a service of another robot."""
        name = self._name(src_id, topic)
        try:
            LOOP_GUARD.add_output(self._sink, self._sink.middleware, (src_id, topic.topic_id), name)
            graph = _with_services(self._sink.middleware, name)
            taker = partial(self._request, src_id, topic)
            # ros2 param and ros2 lifecycle look for the node before they call its services.
            node = name.rpartition("/")[0] if topic.of_node else ""
            self._servers[src_id, topic.topic_id] = graph.serve(name, topic.type_name, taker, node)
        except GrRos2Error as error:
            self._tell_first("not_served", error)  # without the name: another robot chooses as many as it likes

    def _request(self, src_id: int, topic: Topic, client: Hashable, payload: bytes) -> None:
        service = Service(src_id, self._robots[src_id].boot, topic.topic_id, self._name(src_id, topic))
        with self._lock:
            now = self._clock()
            self._send(self._engine.call(service, client, payload, deadline_s=_deadline(topic), now=now), now)

    def _name(self, src_id: int, topic: Topic) -> str:
        return topic.republished(self._sink.config.publish.as_, src_id)

    # ---- frames

    def _type_of(self, event: Delivered) -> str:
        with self._lock:
            topic = self._end.topics_of(event.src_id).get(event.topic_id)
        return "" if topic is None else topic.type_name

    def _receive(self, event: Delivered) -> None:
        with self._lock:
            sender = event.src_id, self._robots[event.src_id].boot
            found = self._engine.receive(sender, event.payload, self._offered, self._clock(), event.age_s)
        try:
            if isinstance(found, Request) and found.service_id == OF_LINK:
                self.link_calls.get(found.payload[0] if found.payload else 0, self.on_link_call)(*sender, found)
            elif isinstance(found, Answer) and callable(found.token):
                found.token(found.payload)
            elif isinstance(found, Request):
                self._clients[found.service_id].call(found.ticket, found.payload)
            elif isinstance(found, Answer):
                self._servers[found.robot, found.service_id].reply(found.token, found.payload)
        except KeyError:
            self._tell_first("not_passed_on", MiddlewareError("a reply came after the server here was closed"))
        except WireError as error:
            self._tell_first("malformed", error)
        except GrRos2Error as error:
            self._tell_first("not_passed_on", error)

    def _send(self, frame: OutgoingFrame | None, now: float) -> None:
        """Send a frame. Called with the lock held."""
        if frame is not None:
            self._messages.submit(self._topic_id, frame.data, now, frame.lifespan_s, frame.robot)
            self._rouse()

    def _tell_first(self, counter: str, error: Exception) -> None:
        with self._lock:
            self._counters[counter] += 1
            first = self._counters[counter] == 1
        if first:
            _log.warning("calls: %s (counted as %s)", error, counter)


def has_room_for_calls(topics: Registry) -> bool:
    """Whether these topics leave one for requests and replies, or were made to."""
    return len(topics) < MAX_TOPICS or bool(topics.services)


def _deadline(topic: Topic) -> float:
    """s that a call of a service waits for its reply."""
    if topic.options.deadline_s != AUTO:
        return topic.options.deadline_s
    return NO_DEADLINE if topic.name.endswith(_NEVER_LATE) else DEADLINE_S


def _with_services(graph: Middleware, service: str) -> ServiceGraph:
    if not isinstance(graph, ServiceGraph):
        raise ConfigError(f"service {service}: middleware {graph.name} carries topics only; take dds, or rclpy")
    return graph
