"""ROS Sink: packets in on message port `pdus`, ROS topics out (the paper, sections 4.2 and 4.4).

Invariants: this block is a thin shell. All behaviour is in the link's engine, which one lock protects. Only the bytes
of a PDU are trusted. The message handler and the timeout thread never raise, because an exception would end them while
the flowgraph seems to run. Messages are published in the order in which they become complete. A message counts as
delivered only after it was published. Everything else is counted by name.
"""

from __future__ import annotations

import threading
import time
import weakref
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from math import inf
from typing import Any, Protocol

from gnuradio import gr

from gr_ros2.core.errors import ConfigError, DescriptionError, GrRos2Error, SealError
from gr_ros2.core.guard import Guard
from gr_ros2.core.names import topic_fault
from gr_ros2.gr.early import CHECK_S, EarlyMessages
from gr_ros2.gr.ends import LOOP_GUARD, EndpointSetup, Graph, LiveEnd, make_endpoint, read_registry, settings, start_of
from gr_ros2.gr.frame_ids import TF_TYPE, FramePrefix, MergedTransforms
from gr_ros2.gr.latency import CLOCK_TYPE, RECENT, LatencyWindow, has_header, leading_time
from gr_ros2.gr.readable import debug_logger, describe
from gr_ros2.link import Delivered, Received, ReceivedPacket, ReceiverEvent, Rejected
from gr_ros2.link.events import Announced
from gr_ros2.link.ledger_rows import LedgerRow
from gr_ros2.link.observe import LinkObserver
from gr_ros2.middleware import Middleware, Publisher, Qos, Subscription
from gr_ros2.middleware.services import ServiceGraph
from gr_ros2.middleware.type_definitions import known
from gr_ros2.middleware.type_descriptions import Described
from gr_ros2.middleware.type_search import TypeSearch
from gr_ros2.phy.pdus import PDUS, AirPacket, PduPort, packets_of
from gr_ros2.phy.threads import BlockThread
from gr_ros2.settings.config import SinkConfig, TopicOptions, replaced, robot_of
from gr_ros2.settings.fields import AUTO
from gr_ros2.settings.registry import Registry, Topic, announced, check_outputs

_SHORTEST_WAIT_S = 1e-3
_CLOCK_DEPTH = 1
_COUNTED = (
    *("not_a_pair", "not_u8", LedgerRow.PUBLISH_FAILED.value, "handler_failed", "bad_announcement"),
    *("frame_unknown_type", "frame_damaged", "tf_damaged", "tf_static_full", "tf_failed"),
)


class Services(Protocol):
    """What handles the services of other robots, and the requests and replies that arrive."""

    def takes(self, event: ReceiverEvent) -> bool:
        """Handle what an event means for services; returns whether it was a request or a reply."""

    def learn(self, src_id: int, topics: Sequence[Topic]) -> None:
        """Take over the topics and services that a robot announces now."""


@dataclass(slots=True, eq=False)
class _Output:
    """A topic of one sender, as this block publishes it.

    :param stamped: whether its messages begin with a header
    :param name: absolute name on the graph, of the newest publisher
    :param publisher: None until the first message, and after the topic has changed
    :param early: what waits for the subscribers of a new publisher; None where nothing does
    :param opening: held while ``early`` is used
    :param published: number of messages
    :param delivered_at: time of the newest one, s
    """

    topic: Topic
    stamped: bool
    name: str = ""
    publisher: Publisher | None = None
    early: EarlyMessages | None = None
    opening: threading.RLock = field(default_factory=threading.RLock)
    published: int = 0
    delivered_at: float | None = None
    latency: LatencyWindow | None = None


class RosSink(gr.basic_block):  # type: ignore[misc]
    """Reassembles packets into messages and publishes them on a ROS graph.

    Message port: `pdus` in (PMT pair of anything and a u8vector). The first message of each sender and topic creates a
    publisher. ``close`` leaves the graph, and so does the end of the process. A middleware that is passed in open must
    be closed by the caller.

    :param registry: CSV path or Registry, the same as at the source; '' with version 1, where senders announce their
        topics
    :param middleware: a name of ``gr_ros2.middleware.MIDDLEWARE`` or an open Middleware
    :param observer: called with every ReceiverEvent, in order; with Delivered after the message was published. An
        observer that raises is not called again
    :param clock: s, monotonic
    :param end: endpoint of both directions, shared with a source; None: an endpoint that only receives is made
    :ivar live: this endpoint
    :param values: the fields of :class:`gr_ros2.settings.config.SinkConfig`
    :raises ConfigError: for a wrong setting; the message names the key, the value and what is allowed
    """

    def __init__(
        self,
        registry: str | Registry = "",
        *,
        middleware: str | Middleware | None = None,
        observer: LinkObserver | None = None,
        clock: Callable[[], float] = time.monotonic,
        end: LiveEnd | None = None,
        **values: Any,
    ) -> None:
        super().__init__("ros2_sink", None, None)
        self.config = settings(SinkConfig, values, registry, middleware)
        rows = read_registry(registry, needed=not self.config.version)
        self.registry = rows
        if rows:
            check_outputs(rows, self.config)
            self.registry = rows.with_options(self.config.topic_options, announced=self.config.version != 0)
        self._start = EndpointSetup()
        if end is None:
            start = self._start = start_of(self.config, robot_of(None, self.config), reports=False)
            if self.config.key:
                debug_logger("gr_ros2.gr.sink", self.config.debug).warning(
                    "ros2_sink: one way, a key keeps out what is forged or was heard before; what never came here is "
                    "taken from a recording, however old it is"
                )
            end = LiveEnd(lambda observer: make_endpoint(rows, None, self.config, start=start, observer=observer))
        self.live, self._end = end, end.endpoint
        self._announced: dict[tuple[int, int], Topic] = {}
        """Topics that senders have announced, by source id and topic id."""
        self._calls: Services | None = None
        self._observer = observer
        self._guard = Guard("observer of ros2_sink")
        self._clock = clock
        self._log = debug_logger("gr_ros2.gr.sink", self.config.debug)
        self._lock = end.lock
        self._timer_due = threading.Condition(self._lock)
        self._timer_idle = False
        self._running = False
        self._thread = BlockThread()
        self._counters: Counter[str] = Counter()
        self._prefix = FramePrefix(self.config.frame_prefix, self._counters)
        self._transforms: MergedTransforms | None = None
        # Publishers are kept when a robot has gone. Late subscribers still get its map, and a robot that comes back
        # needs no new discovery. There are at most as many as source ids times topics of the registry.
        self._outputs: dict[tuple[int, int], _Output] = {}
        self._opening: set[_Output] = set()
        """The outputs in which something may wait for subscribers."""
        self._stamped: dict[str, bool] = {}
        """Whether messages of a type begin with a header."""
        self._types: TypeSearch | None = None
        self._said: set[str] = set()
        self._sim_time: float | None = None
        self._clock_subscription: Subscription | None = None
        self._heard: dict[int, float] = {}
        """When a packet of each robot was taken last, s."""
        self.handled = 0
        """Number of PDUs that this block has finished with, whatever the result."""
        self.message_port_register_in(PDUS)
        self.set_msg_handler(PDUS, self._handle)
        PduPort.readable_by(self)
        self._graph = Graph(middleware, self.config.middleware, self.config.domain_id, "gr_ros2_sink")
        self._finalizer = weakref.finalize(self, self._graph.close)
        try:
            LOOP_GUARD.add_sink(self, self._graph, self.config, self.registry)
            if self.config.merge_tf:
                self._transforms = MergedTransforms(self.config.merged_topics, self.middleware, self._counters)
            if self.config.use_sim_time:
                qos = Qos("best_effort", "volatile", _CLOCK_DEPTH)
                self._clock_subscription = self.middleware.subscribe("/clock", CLOCK_TYPE, qos, self._set_sim_time)
        except GrRos2Error:
            self.close()
            raise

    @property
    def graph(self) -> Graph:
        """The ROS graph on which it publishes."""
        return self._graph

    @property
    def middleware(self) -> Middleware:
        """This block's participant on the ROS graph."""
        return self._graph.middleware

    def share(self, calls: Services) -> None:
        """Hand over what concerns services."""
        self._calls = calls

    @property
    def matched(self) -> bool:
        """Whether every publisher has found a subscription."""
        return all(publisher.matched() for publisher in self._publishers())

    def announce(self, src_id: int, topic_ids: Iterable[int]) -> None:
        """Create the publishers of an expected sender now, so that subscribers find them before its first message.

        :raises MiddlewareError: when a topic cannot be announced
        """
        for topic_id in topic_ids:
            key = (src_id, topic_id)
            output = self._output(key)
            if output.publisher is None:
                self._advertise(key, output)

    def start(self) -> bool:
        with self._lock:
            self._running = True
        self._thread.start(self._watch_timeouts, "gr-ros2-sink")
        if isinstance(self.middleware, ServiceGraph):
            self._types = TypeSearch(self.middleware, self._unknown_types, self._define)
        return True

    def stop(self) -> bool:
        self._stop_search()
        with self._lock:
            self._running = False
            self._timer_due.notify_all()
        self._thread.stop()
        self._release(self._opening)
        return True

    def close(self) -> None:
        """Leave the ROS graph. Idempotent."""
        self._stop_search()
        self._release(self._opening)
        if self._clock_subscription is not None:
            self._clock_subscription.close()
            self._clock_subscription = None
        if self._transforms is not None:
            self._transforms.close()
        for publisher in self._publishers():
            publisher.close()
        LOOP_GUARD.remove(self)
        self._finalizer()
        self._start.close()

    def stats(self) -> dict[str, Any]:
        """A snapshot. ``packet_loss_est`` and ``message_loss_est`` are estimates from gaps in numbers."""
        with self._lock:
            stats = self._end.received
            keys = dict.fromkeys([*stats.delivered, *((src, tid) for src, tid, _ in stats.lost)])
            topics = {key: self._topic_stats(key) for key in keys if self._is_topic(key)}
            outputs = {key: self._outputs[key] for key in topics if key in self._outputs}
            windows = {key: window.copy() for key, output in outputs.items() if (window := output.latency) is not None}
            counted = {
                "packets": stats.packets,
                "handled": self.handled,
                "rejected": dict(stats.rejected),
                "dropped": dict(stats.dropped),
                **{name: self._counters[name] for name in _COUNTED},
                "observer_missed": self._guard.missed,
                "repeats": stats.repeats,
                "repaired": stats.repaired.total(),
                "packet_loss_est": stats.packet_loss_est,
                "unknown_gaps": stats.unknown_gaps,
                "message_loss_est": stats.message_loss_est,
                "silence_s": {src_id: self._clock() - at for src_id, at in self._heard.items()},
                "held_bytes": self._end.held_bytes,
                "latency_clock": "stamp_sim" if self.config.use_sim_time else "stamp_wall",
                "middleware": dict(self.middleware.counters),
            }
        # There may be thousands of latencies. They are sorted without the lock, because the next packet waits for it.
        for key, window in windows.items():
            summaries = {"latency_s": window.summary(), "recent_latency_s": window.summary(RECENT)}
            topics[key] |= {name: summary._asdict() for name, summary in summaries.items()}
        named: dict[str, dict[str, Any]] = {}
        for key, topic in topics.items():  # of a topic that has changed its type, the newest row has the figures
            name = self._name(key)
            if name in named:
                topic["delivered"] += named[name]["delivered"]
            named[name] = topic
        return {**counted, "topics": named}

    def set_debug(self, debug: bool) -> None:
        """Turn the readable log of headers, topic ids and entries on or off."""
        with self._lock:
            self.config = replaced(self.config, debug=debug)
        self._log = debug_logger(self._log.name, self.config.debug)

    def _stop_search(self) -> None:
        if self._types is not None:
            self._types.close()
            self._types = None

    def _unknown_types(self) -> list[tuple[str, str]]:
        """The topics published whose types ROS does not ship."""
        outputs = [(key, output) for key, output in list(self._outputs.items()) if output.publisher is not None]
        types = [(self._name(key), output.topic.type_name) for key, output in outputs]
        return [(name, type_name) for name, type_name in types if not known(type_name)]

    def _define(self, described: Described) -> None:
        """Take a definition that a subscriber has given, for frame names and latencies."""
        try:
            store = described.store()
        except DescriptionError as error:
            self._log.info("ros2_sink: %s", error)
            return
        self._prefix.learn(described.type_name, store)
        stamped = self._stamped[described.type_name] = has_header(described.type_name, store)
        for output in list(self._outputs.values()):
            if output.topic.type_name == described.type_name:
                output.stamped = stamped

    def name_here(self, src_id: int, name: str) -> str:
        """Absolute name under which a sender's topic comes out, by its name in a registry."""
        options = self.config.topic_options.get(name, TopicOptions())
        return Topic(0, name, "", options).republished(self.config.namespace_format, src_id)

    def _name(self, key: tuple[int, int]) -> str:
        return self._topic(key).republished(self.config.namespace_format, key[0])

    def _topic(self, key: tuple[int, int]) -> Topic:
        """The topic that a sender's topic id means, from its announcement or from the registry.

        :raises ConfigError: when the topic id is in neither of them
        """
        topic = self._announced.get(key)
        if topic is not None:
            return topic
        if key[1] < len(self.registry):
            return self.registry[key[1]]
        raise ConfigError(f"topic id {key[1]} of robot {key[0]} is neither announced nor in the registry")

    def _is_topic(self, key: tuple[int, int]) -> bool:
        """Whether a sender's topic id means a topic: neither its table, nor its calls, nor something unknown."""
        topic = self._announced.get(key)
        return key[1] < len(self.registry) if topic is None else topic.is_topic

    def _learn(self, event: Announced) -> None:
        """Take over the topics that a sender announces. A publisher whose topic has a new name or type is closed."""
        topics = []
        for row in event.rows:
            key = (event.src_id, row.topic_id)
            try:
                topic = announced(row, self.config.topic_options)
                name = topic.republished(self.config.namespace_format, event.src_id)
                if topic.is_topic:
                    LOOP_GUARD.add_output(self, self._graph, key, name)
                if fault := topic_fault(name):
                    raise ConfigError(f"topic {name!r}: {fault}")
            except ConfigError as error:
                self._tell_first("bad_announcement", f"a topic of robot {event.src_id} cannot be published", error)
                continue
            topics.append(topic)
            self._announced[key] = topic
            if key in self._outputs:
                self._change(self._outputs[key], topic)
        if self._calls is not None:
            self._calls.learn(event.src_id, topics)

    def _topic_stats(self, key: tuple[int, int]) -> dict[str, Any]:
        stats = self._end.received
        output = self._outputs.get(key)
        window = None if output is None else output.latency
        delivered_at = None if output is None else output.delivered_at
        latency = 0.0 if window is None else window.newest or 0.0
        return {
            "src_id": key[0],
            "topic_id": key[1],
            "type": self._topic(key).type_name,
            "delivered": 0 if output is None else output.published,
            "lost": {reason: count for (*whose, reason), count in stats.lost.items() if tuple(whose) == key},
            "latency_s": None,
            "recent_latency_s": None,
            "age_s": None if delivered_at is None else self._clock() - delivered_at + latency,
        }

    def _handle(self, message: Any) -> None:
        packets, problem = packets_of(message)
        try:
            if problem:
                self._refuse(problem)
            else:
                self._take(packets)
        except Exception as error:  # noqa: BLE001 - an exception would end the block's thread and all reception
            self._failed(error)
        self.handled += max(len(packets), 1)

    def _failed(self, error: Exception) -> None:
        """Count an unexpected error, and log the first one."""
        with self._lock:
            self._counters["handler_failed"] += 1
            first = self._counters["handler_failed"] == 1
        if first:
            self._log.error("ros2_sink: %s", error, exc_info=error)

    def _refuse(self, problem: str) -> None:
        """Count a message that is not a packet, and log the first one."""
        with self._lock:
            self._counters[problem] += 1
            first = self._counters[problem] == 1
        if first:
            self._log.warning("ros2_sink: a message that is no PDU of bytes (%s) was dropped", problem)

    def _take(self, packets: Iterable[AirPacket]) -> None:
        events: list[ReceiverEvent] = []
        with self._lock:
            for packet in packets:
                events += self._end.receive(ReceivedPacket(packet.data, packet.at, packet.snr_db), self._clock())
            if self._timer_idle and self._end.next_timeout() is not None:
                self._timer_due.notify_all()
            if self._end.answers:
                self.live.wake()
        self._settle(events)

    def _settle(self, events: Iterable[ReceiverEvent]) -> None:
        """Handle each event, then call the observer."""
        debug, calls = self.config.debug, self._calls
        for event in events:
            try:
                if debug and isinstance(event, Received | Rejected):
                    self._log.debug("rx %s", describe(event, self.registry))
                if isinstance(event, Received):
                    self._heard[event.packet.src_id] = self._clock()
                elif isinstance(event, Announced):
                    self._learn(event)
                elif isinstance(event, Rejected):
                    self._warn(event)
                taken = calls is not None and calls.takes(event)
                if isinstance(event, Delivered) and not taken:
                    self._deliver(event)
                else:
                    self._tell(event)
            except Exception as error:  # noqa: BLE001 - an exception would lose the next events and the thread
                self._failed(error)

    def _tell(self, event: ReceiverEvent) -> None:
        if self._observer is not None:
            self._guard(self._observer.receiver_event, event, self._clock())

    def _deliver(self, event: Delivered) -> None:
        """Publish a message, now or when the subscribers of its publisher have found it."""
        output = self._outputs.get((event.src_id, event.topic_id))
        if output is None or output.publisher is None or output.early is not None:
            output = self._opened(event)
        if output is None or output.early is None:
            self._tell(self._publish(event))
            return
        with output.opening:
            if output.early is not None:
                output.early.add(event)
            else:
                self._tell(self._publish(event))

    def _opened(self, event: Delivered) -> _Output | None:
        """The output of a message, with a publisher; None if it cannot have one, which publishing then says."""
        key = (event.src_id, event.topic_id)
        try:
            output = self._output(key)
            if output.publisher is None:
                self._advertise(key, output)
        except Exception:  # noqa: BLE001 - publishing fails for the same reason, and counts it
            return None
        return output

    def _release(self, outputs: Iterable[_Output]) -> None:
        """Publish what waits for subscribers."""
        for output in list(outputs):
            with output.opening:
                if output.early is not None:
                    for event in output.early.waiting:
                        self._tell(self._publish(event))
                output.early = None
            with self._lock:
                self._opening.discard(output)

    def _publish(self, event: Delivered) -> ReceiverEvent:
        key = (event.src_id, event.topic_id)
        try:
            output = self._outputs.get(key) or self._output(key)
            topic = output.topic
            payload = self._prefix.apply(topic.type_name, event.src_id, event.payload)
            publisher = output.publisher or self._advertise(key, output)
            publisher.publish(payload)
        except Exception as error:  # noqa: BLE001 - whatever the reason, nobody got the message
            named = f"topic id {key[1]} of robot {key[0]}"
            self._tell_first(LedgerRow.PUBLISH_FAILED.value, f"a message of {named} was not published", error)
            with self._lock:
                return self._end.unpublished(event)
        with self._lock:
            output.published += 1
            output.delivered_at = self._clock()
            if output.stamped:
                self._measure(output, event.payload)
        if self._transforms is not None and topic.type_name == TF_TYPE:
            self._merge(self._transforms, payload, static=topic.latched)
        return event

    def _warn(self, event: Rejected) -> None:
        """Log each refusal that concerns keys, once for each reason."""
        if isinstance(event.error, SealError) and event.error.kind not in self._said:
            self._said.add(event.error.kind)
            self._log.warning("ros2_sink: a packet was refused (%s): %s", event.error.kind, event.error)

    def _merge(self, transforms: MergedTransforms, payload: bytes, *, static: bool) -> None:
        try:
            transforms.add(payload, static=static)
        except Exception as error:  # noqa: BLE001 - the message itself was published and counts as delivered
            self._tell_first("tf_failed", "transforms were not merged", error)

    def _tell_first(self, counter: str, what: str, error: Exception) -> None:
        """Count a failure and log the first one, with a traceback if the error is not one of this project."""
        with self._lock:
            self._counters[counter] += 1
            first = self._counters[counter] == 1
        if first:
            trace = None if isinstance(error, GrRos2Error) else error
            self._log.warning("ros2_sink: %s: %s", what, error, exc_info=trace)

    def _output(self, key: tuple[int, int]) -> _Output:
        """A sender's topic, which may be published from now on.

        :raises ConfigError: when the topic id is neither announced nor in the registry
        """
        output = self._outputs.get(key)
        if output is None:
            topic = self._topic(key)
            output = self._outputs[key] = _Output(topic, self._is_stamped(topic.type_name))
        return output

    def _change(self, output: _Output, topic: Topic) -> None:
        """A topic id means this topic now. A publisher of another name or type is closed."""
        before = output.topic
        if (before.name, before.type_name) != (topic.name, topic.type_name):
            self._release([output])
            output.stamped = self._is_stamped(topic.type_name)
            if output.publisher is not None:
                output.publisher.close()
                output.publisher = None
        output.topic = topic

    def _is_stamped(self, type_name: str) -> bool:
        stamped = self._stamped.get(type_name)
        if stamped is None:
            stamped = self._stamped[type_name] = has_header(type_name)
        return stamped

    def _publishers(self) -> list[Publisher]:
        return [publisher for output in list(self._outputs.values()) if (publisher := output.publisher) is not None]

    def _advertise(self, key: tuple[int, int], output: _Output) -> Publisher:
        topic = output.topic
        depth = topic.options.depth
        if depth == AUTO:
            depth = 1 if topic.latched else self.config.publisher_depth
        asked = topic.options.reliability
        qos = Qos(None if asked == AUTO else asked, "transient_local" if topic.latched else "volatile", depth)
        name = self._name(key)
        for (src_id, _), other in list(self._outputs.items()):
            if src_id == key[0] and other is not output and other.publisher is not None and other.name == name:
                self._release([other])  # the same topic with its type before
                other.publisher.close()
                other.publisher = None
        output.name = name
        publisher = output.publisher = self.middleware.advertise(name, topic.type_name, qos)
        if self._running and self.middleware.settling_s and not topic.latched:
            output.early = EarlyMessages(publisher, self.middleware.settling_s, self._clock())
            with self._lock:
                self._opening.add(output)
                self._timer_due.notify_all()
        return publisher

    def _measure(self, output: _Output, payload: bytes) -> None:
        """Note the latency of a message; the caller holds the lock."""
        now = self._sim_time if self.config.use_sim_time else time.time()
        stamp = leading_time(payload)
        if now is not None and stamp is not None:
            if output.latency is None:
                self._forget_the_gone()
                output.latency = LatencyWindow()
            output.latency.add(now - stamp)

    def _forget_the_gone(self) -> None:
        """Free the latencies of senders that the receiver no longer knows: 0.3 MB per topic."""
        for (src_id, _), output in list(self._outputs.items()):
            if not self._end.knows(src_id):
                output.latency = None

    def _set_sim_time(self, payload: bytes) -> None:
        self._sim_time = leading_time(payload)

    def _watch_timeouts(self) -> None:
        while True:
            self._release([o for o in list(self._opening) if o.early is None or o.early.over(self._clock())])
            with self._lock:
                if not self._running:
                    return
                events = self._end.handle_timeout(self._clock())
                if not events:
                    at = self._end.next_timeout()
                    if self._opening:
                        at = min(self._clock() + CHECK_S, inf if at is None else at)
                    self._timer_idle = at is None
                    self._timer_due.wait(None if at is None else max(_SHORTEST_WAIT_S, at - self._clock()))
                    self._timer_idle = False
            self._settle(events)
