"""ROS Source: ROS topics in, packets out on message port `pdus` (the paper, sections 4.1 and 4.3).

Invariants: this block is a thin shell. All behaviour is in the link's engine, which one lock protects. One pump thread
composes each packet just before it leaves. A callback of the middleware blocks only with ``backpressure``. Every
dropped message is counted by name.
"""

from __future__ import annotations

import logging
import random
import threading
import time
import weakref
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from math import inf
from typing import Any

import pmt
from gnuradio import gr

from gr_ros2.core.errors import ConfigError, GrRos2Error
from gr_ros2.core.guard import Guard
from gr_ros2.gr.ends import LOOP_GUARD, EndpointSetup, Graph, LiveEnd, make_endpoint, read_registry, settings, start_of
from gr_ros2.gr.frame_ids import STATIC_DEPTH, TF_TYPE, StaticTransforms
from gr_ros2.gr.pmts import PduMaker
from gr_ros2.gr.readable import debug_logger, describe
from gr_ros2.gr.topic_search import TopicSearch
from gr_ros2.link import Refused, SenderEvent, SentPacket
from gr_ros2.link.ledger_rows import LedgerRow
from gr_ros2.link.observe import LinkObserver
from gr_ros2.link.rate import Mcs
from gr_ros2.middleware import Middleware, Qos, Subscription, TopicInfo
from gr_ros2.middleware.adapt import agreed
from gr_ros2.middleware.services import OTHER_RMW, ServiceGraph
from gr_ros2.middleware.type_descriptions import Described
from gr_ros2.middleware.type_search import TypeSearch
from gr_ros2.phy.pdus import CREDIT, AirPacket, PduPort
from gr_ros2.phy.threads import BlockThread
from gr_ros2.settings.config import SourceConfig, replaced
from gr_ros2.settings.fields import AUTO, Auto
from gr_ros2.settings.registry import MAX_TOPICS, NewTopic, Registry, Topic, normalize_type, options_of
from gr_ros2.settings.service_rows import ServiceRow, is_service, parts, rows_of
from gr_ros2.settings.topic_choice import TopicChoice

_COUNTED = ("unread", "held_back_at_close", "pump_failed", "tf_damaged", "tf_static_full")
_BATCH = 32
"""Number of packets composed before the lock is released, so that callbacks do not wait long."""


class RosSource(gr.basic_block):  # type: ignore[misc]
    """Subscribes to topics of a ROS graph and emits their messages as packets.

    Message ports: `pdus` out (PMT pair of metadata ``src_id, dst_id, seq, qos, t_src_wall`` and u8vector); `credit` in,
    optional. From the first `credit` message on, each message lets one packet leave. An integer lets that many leave. A
    real number is the time in s, of this block's clock, since when the air is free: messages that wait all the same
    wait for the computer.

    The block takes messages from its construction on. Packets leave while the flowgraph runs. ``close`` leaves the
    graph, and so does the end of the process. A middleware that is passed in open must be started and closed by the
    caller.

    :param registry: CSV path or Registry
    :param middleware: a name of ``gr_ros2.middleware.MIDDLEWARE`` or an open Middleware
    :param observer: called with every SenderEvent, in order, while the block's lock is held. It must not call the
        block. An observer that raises is not called again
    :param clock: s, monotonic
    :param seed: seed of sequence number and entry ids; None: random
    :param any_length: whether the PHY carries shorter packets in less time (:attr:`gr_ros2.phy.Phy.any_length`). Then
        packets of version 1 are only as long as they need; those of version 0 always have ``packet_len`` bytes
    :param mcs_table: the rates of an adaptive rate (:attr:`gr_ros2.phy.Phy.mcs_table`). Each packet then is a PDU whose
        metadata names its ``mcs``
    :param end: endpoint of both directions, shared with a sink; None: an endpoint that only sends is made
    :param values: the fields of :class:`gr_ros2.settings.config.SourceConfig`
    :raises ConfigError: for a wrong setting; the message names the key, the value and what is allowed
    """

    def __init__(
        self,
        registry: str | Registry = "",
        *,
        middleware: str | Middleware | None = None,
        observer: LinkObserver | None = None,
        clock: Callable[[], float] = time.monotonic,
        seed: int | None = None,
        any_length: bool = False,
        mcs_table: Sequence[Mcs] = (),
        end: LiveEnd | None = None,
        **values: Any,
    ) -> None:
        super().__init__("ros2_source", None, None)
        self.config = settings(SourceConfig, values, registry, middleware)
        rows = read_registry(registry, needed=not self.config.version)
        self.src_id = self.config.src_id()
        """The source id on the wire."""
        self.registry = rows.with_options(self.config.topic_options)
        self._start = EndpointSetup()
        if end is None:
            start = self._start = start_of(
                self.config, self.src_id, reports=False, any_length=any_length, mcs_table=mcs_table
            )
            rng = random.Random(seed)
            end = LiveEnd(
                lambda observer: make_endpoint(rows, self.config, None, start=start, rng=rng, observer=observer)
            )
        end.observer = self._observe
        self._live, self._end = end, end.endpoint
        self._messages = end.endpoint.messages
        self._observer = observer
        self._guard = Guard(f"observer of ros2_source {self.src_id}")
        self.clock = clock
        self._pdus = PduMaker()
        self._mcs = 0
        """MCS of the newest packet."""
        self._log = debug_logger("gr_ros2.gr.source", self.config.debug)
        self._lock, self._work = end.lock, end.work
        self._room = threading.Condition(self._lock)
        self._running = False
        self._closed = False
        self._thread = BlockThread()
        self._looked = -inf
        """When the sending thread last began to look for packets, s."""
        self._unread = False
        self._counters: Counter[str] = Counter()
        self.emitted = 0
        """Number of PDUs that have left."""
        self._said: set[tuple[int, str]] = set()
        static = [topic for topic in self.registry if topic.latched and topic.type_name == TF_TYPE]
        self._static = {topic.topic_id: StaticTransforms(self._counters) for topic in static}
        self._subscriptions: dict[int, Subscription] = {}
        self._port = PduPort(self)
        self.message_port_register_in(CREDIT)
        self.set_msg_handler(CREDIT, self._credit)
        namespace, words = self.config.namespace, self.config.topics
        chosen = self.registry.chosen(words) if self.registry else []
        self.subscribed = {topic.on_graph(namespace): topic for topic in chosen if topic.is_topic}
        """Topics by their absolute names on the ROS graph. The mapping is replaced as a whole when a topic is added."""
        self.services = {topic.on_graph(namespace): topic for topic in chosen if topic.is_service}
        """The same for the services that other robots may call."""
        self.choice = TopicChoice(() if self.registry else words, namespace)
        """The topics and services that are looked for on the ROS graph."""
        self.offered: set[str] = set()
        """Absolute names of the services, actions and nodes that were found and chosen."""
        self._offer: Callable[[str, Topic], None] | None = None
        self._left_out: set[str] = set()
        self.not_offered: set[str] = set()
        """Services that cannot be called because of the RMW of their nodes. Only the first one is logged."""
        self._full = False
        """Whether a topic was not sent because there are too many. Only the first one is logged."""
        self._search: TopicSearch | None = None
        self._types: TypeSearch | None = None
        node_name = f"gr_ros2_source_{self.src_id}"
        self._graph = Graph(middleware, self.config.middleware, self.config.domain_id, node_name)
        self._finalizer = weakref.finalize(self, self._graph.close)
        try:
            LOOP_GUARD.add_source(self, self._graph, [*self.subscribed, *self.services])
            self._subscribe()
        except GrRos2Error:
            self.close()
            raise

    @property
    def middleware(self) -> Middleware:
        """This block's participant on the ROS graph."""
        return self._graph.middleware

    @property
    def idle(self) -> bool:
        """Whether no message is waiting or being sent."""
        with self._lock:
            return self._end.idle

    @property
    def matched(self) -> bool:
        """Whether every subscription has found a publisher."""
        return not self.unmatched

    @property
    def unmatched(self) -> list[str]:
        """Names, on the ROS graph, of the topics without a publisher; the patterns, if no name is known yet."""
        subscriptions, subscribed = self._subscriptions, self.subscribed
        unseen = [name for name in self.choice.named if name not in subscribed and name not in self.offered]
        if self.choice.open and not subscribed and not unseen:
            return [self.choice.everything]
        waiting = {name: subscriptions.get(topic.topic_id) for name, topic in subscribed.items()}
        return unseen + [name for name, end in waiting.items() if end is not None and not end.matched()]

    def stalled_s(self, now: float) -> float:
        """s for which the sending thread has been at one thing, or asleep beyond the time at which it meant to look
        again; infinite if it has ended. Takes no lock, which that thread may hold.

        :param now: s of this block's clock
        """
        if not self._running:
            return 0.0
        if not self._thread.alive:
            return inf
        awake = self._live.sleeps_until == -inf
        return max(0.0, now - (self._looked if awake else self._live.sleeps_until))

    def rate(self) -> dict[str, str]:
        """With an adaptive rate, the name of the mcs of the newest packet as ``mcs``; otherwise nothing."""
        mcs_table = self._end.mcs_table
        return {"mcs": mcs_table[self._mcs].name} if mcs_table else {}

    def use_credit(self) -> None:
        """Let no packet leave before the first `credit` message."""
        with self._lock:
            self._end.pace.use_credit()

    def offer_with(self, offer: Callable[[str, Topic], None]) -> None:
        """Look for services too, from the next start on, unless ``services`` of the settings is false.

        :param offer: called with the name of each service on the ROS graph and its row, from a thread of this block
        """
        self._offer = offer if self.config.services else None

    def start(self) -> bool:
        self._unread = not self._port.find_readers()
        if self._unread:
            self._log.error("ros2_source %d: nothing reads message port `pdus`; connect it", self.src_id)
        self._looked = self.clock()
        with self._lock:
            self._running = True
        self._thread.start(self._pump, f"gr-ros2-source-{self.src_id}")
        if self.choice:
            self._search = TopicSearch(self.middleware, self._found, services=self._offer is not None)
        if self.config.version and self.config.compresses and isinstance(self.middleware, ServiceGraph):
            self._types = TypeSearch(self.middleware, self._types_in_use, self._learn)
        return True

    def stop(self) -> bool:
        self._stop_search()
        with self._lock:
            self._running = False
            self._take_losses()
            self._work.notify_all()
        self._thread.stop()
        return True

    def close(self) -> None:
        """Leave the ROS graph. A callback held back by ``backpressure`` returns without submitting. Idempotent."""
        self._stop_search()
        with self._lock:
            self._closed = True
            self._room.notify_all()
        for subscription in self._subscriptions.values():
            subscription.close()
        with self._lock:
            self._take_losses()
        self._subscriptions.clear()
        LOOP_GUARD.remove(self)
        self._finalizer()
        self._start.close()

    def stats(self) -> dict[str, Any]:
        """A snapshot of the counters of packets and messages, per topic and in total."""
        with self._lock:
            self._take_losses()
            stats = self._end.sent
            queued = self._messages.queued()
            rows: dict[str, list[int]] = {}
            for topic in self.registry:
                if topic.is_topic:
                    rows.setdefault(topic.name, []).append(topic.topic_id)
            topics = {
                name: {
                    "topic_id": topic.topic_id,
                    "type": topic.type_name,
                    "types": len(rows[topic.name]),
                    "submitted": sum(stats.submitted[row] for row in rows[topic.name]),
                    LedgerRow.LOST_ON_GRAPH.value: sum(stats.missed[row] for row in rows[topic.name]),
                    "sent": sum(stats.sent[row] for row in rows[topic.name]),
                    "queued": sum(queued[row] for row in rows[topic.name]),
                    "queue": self._messages.queue(topic.topic_id)[0],
                    "queue_depth": self._messages.depth(topic.topic_id),
                    "refused": {
                        reason: sum(stats.refused[row, reason] for row in rows[topic.name])
                        for reason in sorted({why for row, why in stats.refused if row in rows[topic.name]})
                    },
                }
                for name, topic in self.subscribed.items()
            }
            return {
                "src_id": self.src_id,
                "packets": stats.packets,
                "entries": stats.entries,
                "payload_bytes": stats.payload_bytes,
                "repeats": stats.repeats,
                "air": dict(stats.air),
                **{name: self._counters[name] for name in _COUNTED},
                "observer_missed": self._guard.missed,
                "unmatched": self.unmatched,
                "topics": topics,
                "middleware": dict(self.middleware.counters),
            }

    def set_packet_rate(self, packet_rate: float | Auto) -> None:
        """Set the largest packet rate, packets/s. With auto, the credits set the pace; with 0 there is no limit.

        :raises ConfigError: out of range, as in all setters
        """
        self._reconfigure(packet_rate=packet_rate)

    def set_dst_id(self, dst_id: int) -> None:
        """Set the destination id; 255 is broadcast."""
        self._reconfigure(dst_id=dst_id)

    def set_queue_depth(self, queue_depth: int) -> None:
        """Set how many messages may wait per topic; 0 is unlimited."""
        self._reconfigure(queue_depth=queue_depth)

    def set_repeat_s(self, repeat_s: float) -> None:
        """Set the time between repeats of a transient-local topic, s; 0 is off."""
        self._reconfigure(repeat_s=repeat_s)

    def set_debug(self, debug: bool) -> None:
        """Turn the readable log of headers, topic ids and entries on or off."""
        with self._lock:
            self.config = replaced(self.config, debug=debug)
        self._log = debug_logger(self._log.name, self.config.debug)

    def _reconfigure(self, **changes: Any) -> None:
        with self._lock:
            config = replaced(self.config, **changes)
            self._end.reconfigure(**changes)
            self.config = config
            self._work.notify_all()
            self._room.notify_all()

    def _subscribe(self) -> None:
        for name, topic in self.subscribed.items():
            self._subscribe_to(name, topic)
        if self._graph.owned:
            self.middleware.start()

    def _subscribe_to(self, name: str, topic: Topic) -> None:
        options = topic.options
        depth = self.config.subscriber_depth if options.depth == AUTO else options.depth
        if topic.topic_id in self._static and depth:
            depth = max(depth, STATIC_DEPTH)
        reliability = None if options.reliability == AUTO else options.reliability
        durability = None if options.durability == AUTO else options.durability
        qos = Qos(reliability, durability, depth)
        callback = partial(self._take, topic.topic_id)
        subscription = self.middleware.subscribe(name, topic.type_name, qos, callback)
        self._subscriptions = {**self._subscriptions, topic.topic_id: subscription}
        subscription.follow(partial(self._follow, topic))

    def _stop_search(self) -> None:
        for search in (self._search, self._types):
            if search is not None:
                search.close()
        self._search = self._types = None

    def _types_in_use(self) -> list[tuple[str, str]]:
        return [(name, topic.type_name) for name, topic in self.subscribed.items()]

    def _learn(self, described: Described) -> None:
        """Code messages of a type by the definition that a node has given."""
        with self._lock:
            self._messages.learn(described.type_name, described.types)
            self._work.notify()

    def _found(self, infos: Sequence[TopicInfo], services: Mapping[str, str]) -> None:
        """Send the topics of the graph that are chosen and not sent yet, or have another type now; likewise the
        services."""
        published = {(info.topic, info.type_name) for info in infos if info.publishers}
        for info in infos:
            sent = self.subscribed.get(info.topic)
            if not info.publishers or (sent is not None and (info.topic, sent.type_name) in published):
                continue
            row_name = self.choice.row_name(info.topic)
            if row_name is None or info.topic in self._left_out or LOOP_GUARD.returns(self._graph, info.topic):
                continue
            try:
                self._add(row_name, info)
            except GrRos2Error as error:
                self._leave_out(info.topic, f"topic {info.topic} is not sent", error)
        uncallable = (
            self.middleware.uncallable() if services and isinstance(self.middleware, ServiceGraph) else frozenset()
        )
        for row in rows_of(services):
            row_name = self.choice.row_name(row.name, hidden=row.of_node)
            if row_name is None or self._is_offered(row) or f"{row.name} {row.kind}" in self._left_out:
                continue
            if not uncallable.isdisjoint(parts(row.name, row.kind)):
                if not self.not_offered:
                    self._log.warning("%s (%s) is not offered: its node %s", row.name, row.kind, OTHER_RMW)
                self.not_offered.add(row.name)
                continue
            try:
                self._add_services(row_name, row)
            except GrRos2Error as error:
                self._leave_out(f"{row.name} {row.kind}", f"{row.name} ({row.kind}) is not offered", error)

    def _leave_out(self, key: str, what: str, error: GrRos2Error) -> None:
        """Say once what cannot be sent; of what finds no room, only the first."""
        self._left_out.add(key)
        full = len(self.registry) == MAX_TOPICS
        level = logging.DEBUG if full and self._full else logging.WARNING
        self._full = full
        self._log.log(level, "%s: %s", what, error)

    def _is_offered(self, row: ServiceRow) -> bool:
        """Whether the services of a row are offered already, or have come by radio."""
        names = parts(row.name, row.kind)
        return any(name in self.services or LOOP_GUARD.returns(self._graph, name) for name in names)

    def _add_services(self, row_name: str, row: ServiceRow) -> None:
        """Offer the services of a row to other robots. The topics of an action are sent.

        :raises ConfigError: for a row that cannot be offered, such as one more than a link carries
        """
        assert self._offer is not None
        rows: dict[str, NewTopic] = {}
        for name, type_name in parts(row.name, row.kind).items():
            if not self.choice.leaves_out(name):
                part = row_name + name.removeprefix(row.name)
                rows[name] = part, type_name, options_of(part, self.config.topic_options)
        if not any(is_service(type_name) for _, type_name, _ in rows.values()):
            raise ConfigError("topics leaves out all its services")
        with self._lock:
            self.registry = self._messages.add(list(rows.values()))
            added = dict(zip(rows, self.registry[-len(rows) :], strict=True))
            self.services = {**self.services, **{name: topic for name, topic in added.items() if topic.is_service}}
            topics = {name: topic for name, topic in added.items() if topic.is_topic}
            self.subscribed = {**self.subscribed, **topics}
        self.offered.add(row.name)
        LOOP_GUARD.add_source(self, self._graph, [*self.subscribed, *self.services])
        self._log.info("%s (%s) of the ROS graph is offered to other robots", row.name, row.kind)
        for name, topic in added.items():
            if topic.is_service:
                self._offer(name, topic)
            else:
                self._subscribe_to(name, topic)

    def _add(self, row_name: str, info: TopicInfo) -> None:
        """Announce a topic of the graph, and subscribe it. It may be sent already, with a type that has no publisher
        any more; each type of a topic has its own row.

        :raises ConfigError: for a topic that cannot be sent, such as one more than a link carries
        """
        options, type_name = options_of(row_name, self.config.topic_options), normalize_type(info.type_name)
        with self._lock:
            before = self.subscribed.get(info.topic)
            rows = [topic for topic in self.registry if (topic.name, topic.type_name) == (row_name, type_name)]
            if not rows:
                self.registry = self._messages.add([(row_name, type_name, options)])
                rows = [self.registry[-1]]
            (topic,) = rows
            subscribed = {**self.subscribed, info.topic: topic}
            self._adapt(topic, info.publishers)
            if topic.type_name == TF_TYPE and all(offer.durability == "transient_local" for offer in info.publishers):
                self._static[topic.topic_id] = StaticTransforms(self._counters)
            self.subscribed = subscribed
            self._work.notify()
        LOOP_GUARD.add_source(self, self._graph, [*subscribed, *self.services])
        if before is None:
            self._log.info("topic %s (%s) of the ROS graph is sent", info.topic, topic.type_name)
        else:
            self._log.warning("topic %s is %s now, was %s", info.topic, topic.type_name, before.type_name)
            self._unsubscribe(before)
        self._subscribe_to(info.topic, topic)

    def _unsubscribe(self, topic: Topic) -> None:
        """Take no further messages of a row, and keep none for robots that join late."""
        subscriptions = dict(self._subscriptions)
        subscriptions.pop(topic.topic_id).close()
        with self._lock:
            self._take_losses()
            self._subscriptions = subscriptions
            self._messages.forget_kept(topic.topic_id)

    def _adapt(self, topic: Topic, offers: Sequence[Qos]) -> bool:
        """Tell the endpoint the QoS of a topic's publishers; return whether its queue changed. The lock is held."""
        qos = agreed(offers)
        return self._messages.follow(
            topic.topic_id,
            reliable=qos.reliability != "best_effort",
            latched=all(offer.durability == "transient_local" for offer in offers),
            depth=qos.depth,
            lifespan_s=qos.lifespan_s,
            period_s=qos.deadline_s,
        )

    def _follow(self, topic: Topic, offers: Sequence[Qos]) -> None:
        """Adapt the queue of a topic to the QoS that its publishers offer, where the queue is not configured."""
        with self._lock:
            changed = self._adapt(topic, offers)
            policy, deadline_s = self._messages.queue(topic.topic_id)
        if changed:
            limit = f", stale after {deadline_s * 1e3:g} ms" if deadline_s else ""
            self._log.info("topic %s: queue %s%s, as its publishers' QoS has it", topic.name, policy, limit)

    def _take(self, topic_id: int, payload: bytes) -> None:
        """Accept a message of the ROS graph, in a thread of the middleware."""
        with self._lock:
            while self.config.backpressure and not self._closed and not self._messages.room(topic_id):
                self._room.wait()
            if self._closed:
                self._counters["held_back_at_close"] += 1
                return
            subscription = self._subscriptions.get(topic_id)
            if subscription is not None and subscription.lost:
                self._messages.missed(topic_id, subscription.lost)
            # A late robot gets only the newest message of a topic. So this message must hold all static transforms.
            static = self._static.get(topic_id)
            whole = None if static is None else static.union(payload)
            self._messages.submit(topic_id, whole or payload, self.clock())
            self._live.wake()

    def _take_losses(self) -> None:
        """Count the messages that the ROS graph lost before they arrived here. Called with the lock held."""
        for topic_id, subscription in self._subscriptions.items():
            self._messages.missed(topic_id, subscription.lost)

    def _credit(self, message: Any) -> None:
        packets = pmt.to_long(message) if pmt.is_integer(message) else 1
        # Whoever waits for room in a queue wants nothing dropped.
        ready = pmt.to_double(message) if pmt.is_real(message) and not self.config.backpressure else inf
        with self._lock:
            self._end.pace.credit(max(0, packets), ready)
            self._live.wake()

    def _pump(self) -> None:
        while self._running:
            self._looked = self.clock()
            try:
                if packets := self._compose():
                    self._emit(packets)
            except Exception as error:  # noqa: BLE001 - an exception would end all transmission
                with self._lock:
                    self._counters["pump_failed"] += 1
                    first = self._counters["pump_failed"] == 1
                if first:
                    self._log.exception("ros2_source %d: %s", self.src_id, error)

    def _compose(self) -> list[SentPacket]:
        """The packets that may leave now. If there are none, wait for a reason to look again and return none."""
        with self._lock:
            packets: list[SentPacket] = []
            while self._running and len(packets) < _BATCH and (sent := self._end.next_packet(self.clock())) is not None:
                packets.append(sent)
            if packets:
                self._mcs = packets[-1].mcs
                self._room.notify_all()
            elif self._running:
                self._live.sleep(self.clock())
        return packets

    def _emit(self, packets: list[SentPacket]) -> None:
        if self.config.debug:
            for sent in packets:
                self._log.debug("tx %s", describe(sent, self.registry))
        adaptive = bool(self._end.mcs_table)
        on_air = [AirPacket(sent.data, sent.mcs if adaptive else None, leave_at=sent.leave_at) for sent in packets]
        if self._port.bundles:
            self._port.send(on_air)
        else:
            wall = time.time()
            for sent, packet in zip(packets, on_air, strict=True):
                self._port.send_pdu(self._pdus.pdu(sent.packet, packet, wall))
        self.emitted += len(packets)
        if self._unread:
            with self._lock:
                self._counters["unread"] += len(packets)

    def _observe(self, event: SenderEvent) -> None:
        if isinstance(event, Refused) and (event.topic_id, event.reason) not in self._said:
            self._said.add((event.topic_id, event.reason))
            name = self.registry[event.topic_id].name if event.topic_id < len(self.registry) else "of calls"
            level = logging.INFO if event.reason == LedgerRow.SUPERSEDED else logging.WARNING  # as `latest` intends
            self._log.log(level, "topic %s: a message was dropped (%s): %s", name, event.reason, event.detail)
        if self._observer is not None:
            self._guard(self._observer.sender_event, self.src_id, event)
