"""The topics of other robots as a robot publishes them.

Invariants: messages are published in the order in which they become complete. A message counts as delivered only after
it was published. Publishers are kept when a robot has gone: late subscribers still get its map, and a robot that comes
back needs no new discovery. There are at most as many as source ids times topics.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from hashlib import blake2b
from typing import Any

from gr_ros2.codecs.received_frames import FrameReceiver, chain_of
from gr_ros2.core.errors import BackendMissingError, CodecError, ConfigError, DescriptionError, GrRos2Error
from gr_ros2.core.names import topic_fault
from gr_ros2.gr.early import EarlyMessages
from gr_ros2.gr.failures import Failures
from gr_ros2.gr.frame_ids import TF_TYPE, FramePrefix, MergedTransforms
from gr_ros2.gr.latency import Latencies, LatencyWindow
from gr_ros2.gr.live_end import LiveEnd
from gr_ros2.gr.loops import LOOP_GUARD
from gr_ros2.gr.stamps import MovedStamps
from gr_ros2.link import Delivered, ReceiverEvent
from gr_ros2.link.clocks import ClockOffset
from gr_ros2.link.endpoint import Endpoint
from gr_ros2.link.events import Announced
from gr_ros2.link.fates import Fate
from gr_ros2.middleware import Middleware, Publisher, Qos
from gr_ros2.middleware.type_definitions import known
from gr_ros2.middleware.type_descriptions import Described
from gr_ros2.settings.fields import AUTO
from gr_ros2.settings.registry import Registry, Topic, announced, options_of
from gr_ros2.settings.robot import PublishConfig, PublishOptions, RobotConfig

Key = tuple[int, int]
"""Source id and topic id."""


class HeardTopics:
    """The topics of all robots that are heard, by source id and topic id."""

    def __init__(self, registry: Registry, publish: PublishConfig) -> None:
        self._registry, self._publish = registry, publish
        self._announced: dict[Key, Topic] = {}

    def announce(self, key: Key, topic: Topic) -> None:
        """A robot says what a topic id means."""
        self._announced[key] = topic

    def announced(self) -> list[tuple[int, str, Topic]]:
        """Source id, absolute name here and meaning of each topic that is announced now."""
        return [(key[0], self.name(key), topic) for key, topic in list(self._announced.items())]

    def name_of(self, src_id: int, name: str) -> str:
        """Absolute name under which a sender's topic comes out, by its name in a registry."""
        named = options_of(name, self._publish.topics, PublishOptions()).as_
        return Topic(0, name, "", publish_as=named).republished(self._publish.as_, src_id)

    def name(self, key: Key) -> str:
        """Absolute name under which a topic comes out."""
        return self.topic(key).republished(self._publish.as_, key[0])

    def topic(self, key: Key) -> Topic:
        """The topic that a sender's topic id means, from its announcement or from the registry.

        :raises ConfigError: when the topic id is in neither of them
        """
        topic = self._announced.get(key)
        if topic is not None:
            return topic
        if key[1] < len(self._registry):
            return self._registry[key[1]]
        raise ConfigError(f"topic id {key[1]} of robot {key[0]} is neither announced nor in the registry")

    def is_topic(self, key: Key) -> bool:
        """Whether a sender's topic id means a topic: neither its table, nor its calls, nor something unknown."""
        topic = self._announced.get(key)
        return key[1] < len(self._registry) if topic is None else topic.is_topic


@dataclass(slots=True, eq=False)
class Output:
    """A topic of one sender, as this block publishes it.

    :param name: absolute name on the graph, of the newest publisher
    :param publisher: None until the first message, and after the topic has changed
    :param early: what waits for the subscribers of a new publisher; None where nothing does
    :param opening: held while ``early`` is used
    :param published: number of messages
    :param delivered_at: time of the newest one, s
    :param measured_by: how often the clock had been set by which ``latency`` was measured; None: it is not known
    :param way: how many robots have sent it on, and the last of them
    :param kept: digests of the newest messages of a latched topic that comes as frames, by chain
    """

    topic: Topic
    name: str = ""
    publisher: Publisher | None = None
    early: EarlyMessages | None = None
    opening: threading.RLock = field(default_factory=threading.RLock)
    published: int = 0
    delivered_at: float | None = None
    latency: LatencyWindow | None = None
    measured_by: int | None = None
    way: tuple[int, int | None] = (0, None)
    kept: dict[int, bytes] = field(default_factory=dict)


class Outputs:
    """What one sink publishes.

    :param owner: the block, for the loop guard
    :param tell: called with what became of each message
    :param clock: s, monotonic
    :ivar heard: what topic ids mean
    :ivar frames: decodes the topics that come as frames
    :ivar opening: the outputs in which something may wait for subscribers
    :ivar running: whether messages may wait, because somebody looks at ``opening``
    :ivar due: notified when something waits; uses the lock of ``live``
    """

    def __init__(
        self,
        owner: Any,
        registry: Registry,
        config: RobotConfig,
        graph: Middleware,
        live: LiveEnd[Endpoint],
        *,
        tell: Callable[[ReceiverEvent], None],
        clock: Callable[[], float],
        failures: Failures,
        log: logging.Logger,
    ) -> None:
        self.heard = HeardTopics(registry, config.publish)
        self.opening: set[Output] = set()
        self.running = False
        self.due = threading.Condition(live.lock)
        self._owner, self._settings, self._graph, self._end = owner, config.publish, graph, live.endpoint
        self._lock = live.lock
        self._tell, self._clock, self._failures, self._log = tell, clock, failures, log
        self.other_clocks: Callable[[int], ClockOffset | None] = lambda _src_id: None
        """What is known of a robot's clock elsewhere; called without the lock."""
        self._outputs: dict[Key, Output] = {}
        self.frames = FrameReceiver()
        self._prefix = FramePrefix(config.publish.frame_prefix, failures.counters)
        self._stamps = MovedStamps(failures.counters) if config.publish.stamps == "mine" else None
        self._sim_time = config.graph.use_sim_time
        self._transforms: MergedTransforms | None = None
        if config.publish.merge_tf:
            self._transforms = MergedTransforms(config.publish.merged_topics, graph, failures.counters)
        try:
            self._latencies = Latencies(graph, sim_time=config.graph.use_sim_time)
        except GrRos2Error:
            if self._transforms is not None:
                self._transforms.close()
            raise

    def close(self) -> None:
        """Publish what waits, and leave the graph. Idempotent."""
        self.release(self.opening)
        self._latencies.close()
        if self._transforms is not None:
            self._transforms.close()
        for publisher in self.publishers():
            publisher.close()

    def announce(self, src_id: int, topic_ids: Iterable[int]) -> None:
        """Create the publishers of an expected sender now, so that subscribers find them before its first message.

        :raises MiddlewareError: when a topic cannot be announced
        """
        for topic_id in topic_ids:
            key = (src_id, topic_id)
            output = self._output(key)
            if output.publisher is None:
                self._advertise(key, output)

    def take(self, event: Announced) -> list[Topic]:
        """Take over the topics that a sender announces; returns those that can be published. A publisher whose topic
        has a new name or type is closed."""
        topics = []
        for told in event.topics:
            key = (event.src_id, told.topic_id)
            try:
                topic = announced(told, self._settings.topics)
                if (output := self.frames.announce(key, told)) != told.type_name:
                    topic = replace(topic, type_name=output)
                name = topic.republished(self._settings.as_, event.src_id)
                if topic.is_topic:
                    LOOP_GUARD.add_output(self._owner, self._graph, key, name)
                if fault := topic_fault(name):
                    raise ConfigError(f"topic {name!r}: {fault}")
            except (ConfigError, BackendMissingError) as error:
                self._failures.note(
                    "bad_announcement", f"ros2_sink: a topic of robot {event.src_id} cannot be published", error
                )
                continue
            topics.append(topic)
            self.heard.announce(key, topic)
            if key in self._outputs:
                self._change(self._outputs[key], topic)
        return topics

    def types(self) -> list[tuple[str, str]]:
        """Name on the graph and type of each topic that is published and whose type ROS does not ship."""
        outputs = [(key, output) for key, output in list(self._outputs.items()) if output.publisher is not None]
        types = [(self.heard.name(key), output.topic.type_name) for key, output in outputs]
        return [(name, type_name) for name, type_name in types if not known(type_name)]

    def define(self, described: Described) -> None:
        """Take a definition that a subscriber has given, for frame names and latencies."""
        try:
            store = described.store()
        except DescriptionError as error:
            self._log.info("ros2_sink: %s", error)
            return
        self._prefix.learn(described.type_name, store)
        if self._stamps is not None:
            self._stamps.learn(described.type_name, store)
        self._latencies.learn(described.type_name, store)

    def stats(self) -> dict[Key, dict[str, Any]]:
        """The counters of each topic, without its latencies. Called with the lock held."""
        stats = self._end.received
        keys = dict.fromkeys([*stats.delivered, *((src, tid) for src, tid, _ in stats.lost)])
        return {key: self._topic_stats(key) for key in keys if self.heard.is_topic(key)}

    def windows(self) -> dict[Key, LatencyWindow]:
        """Copies of the latencies. Called with the lock held."""
        found = {key: output.latency for key, output in list(self._outputs.items())}
        return {key: window.copy() for key, window in found.items() if window is not None}

    def _topic_stats(self, key: Key) -> dict[str, Any]:
        topic = self.heard.topic(key)
        output = self._outputs.get(key) or Output(topic)
        latency = (output.latency.newest or 0.0) if output.latency is not None else 0.0
        at = output.delivered_at
        lost = self._end.received.lost
        return {
            "src_id": key[0],
            "topic_id": key[1],
            "type": topic.type_name,
            "latched": topic.latched,
            "delivered": output.published,
            "lost": {reason: count for (*whose, reason), count in lost.items() if tuple(whose) == key},
            "latency_s": None,
            "recent_latency_s": None,
            "age_s": None if at is None else self._clock() - at + latency,
            "hops": output.way[0],
            "over": output.way[1],
        }

    def deliver(self, event: Delivered) -> None:
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

    def _opened(self, event: Delivered) -> Output | None:
        """The output of a message, with a publisher; None if it cannot have one, which publishing then says."""
        key = (event.src_id, event.topic_id)
        try:
            output = self._output(key)
            if output.publisher is None:
                self._advertise(key, output)
        except Exception:  # noqa: BLE001 - publishing fails for the same reason, and counts it
            return None
        return output

    def release(self, outputs: Iterable[Output]) -> None:
        """Publish what waits for subscribers."""
        for output in list(outputs):
            with output.opening:
                if output.early is not None:
                    for event in output.early.waiting:
                        self._tell(self._publish(event))
                output.early = None
            with self._lock:
                self.opening.discard(output)

    def _publish(self, event: Delivered) -> ReceiverEvent:
        key = (event.src_id, event.topic_id)
        try:
            output = self._outputs.get(key) or self._output(key)
            topic = output.topic
            shown = self._shown(event, topic)
            framed = topic.latched and shown is not event.payload
            chain, digest = (chain_of(event.payload)[0], blake2b(shown).digest()) if framed else (0, b"")
            if framed and output.kept.get(chain) == digest:
                return event._replace(shown=shown, again=True)
            clock = self._clock_of(event.src_id)
            payload = self._prefix.apply(topic.type_name, event.src_id, shown)
            if self._stamps is not None:
                payload = self._moved(self._stamps, topic.type_name, payload, clock)
            publisher = output.publisher or self._advertise(key, output)
            publisher.publish(payload)
        except Exception as error:  # noqa: BLE001 - whatever the reason, nobody got the message
            named = f"topic id {key[1]} of robot {key[0]}"
            self._failures.note(Fate.PUBLISH_FAILED.value, f"ros2_sink: a message of {named} was not published", error)
            with self._lock:
                return self._end.unpublished(event)
        if framed:
            output.kept[chain] = digest
        with self._lock:
            output.published += 1
            output.delivered_at, output.way = self._clock(), (event.hops, event.over)
            latency_s = self._measure(output, shown, clock) if self._latencies.has(topic.type_name) else None
        if self._transforms is not None and topic.type_name == TF_TYPE:
            self._merge(self._transforms, payload, static=topic.latched)
        if shown is not event.payload:
            event = event._replace(shown=shown)
        return event if latency_s is None else event._replace(latency_s=latency_s)

    def _shown(self, event: Delivered, topic: Topic) -> bytes:
        """The message that a delivered one is: a frame is decoded, and a CameraInfo fitted to its picture.

        :raises CodecError: a frame that cannot be decoded; its robot is asked for a key frame
        """
        try:
            message = self.frames.decode((event.src_id, event.topic_id), topic.name, event.payload, self._clock())
            return self.frames.scaled(event.src_id, topic.name, topic.type_name, message)
        except CodecError:
            with self._lock:
                if self._end.frames is not None:
                    self._end.frames.lost(event.src_id, event.topic_id)
            raise

    def _merge(self, transforms: MergedTransforms, payload: bytes, *, static: bool) -> None:
        try:
            transforms.add(payload, static=static)
        except Exception as error:  # noqa: BLE001 - the message itself was published and counts as delivered
            self._failures.note("tf_failed", "ros2_sink: transforms were not merged", error)

    def _output(self, key: Key) -> Output:
        """A sender's topic, which may be published from now on.

        :raises ConfigError: when the topic id is neither announced nor in the registry
        """
        output = self._outputs.get(key)
        if output is None:
            topic = self.heard.topic(key)
            output = self._outputs[key] = Output(topic)
        return output

    def _change(self, output: Output, topic: Topic) -> None:
        """A topic id means this topic now. A publisher of another name or type is closed."""
        before = output.topic
        if (before.name, before.type_name) != (topic.name, topic.type_name):
            self.release([output])
            if output.publisher is not None:
                output.publisher.close()
                output.publisher = None
        output.topic = topic

    def publishers(self) -> list[Publisher]:
        """All that are open."""
        return [publisher for output in list(self._outputs.values()) if (publisher := output.publisher) is not None]

    def _advertise(self, key: Key, output: Output) -> Publisher:
        topic = output.topic
        depth = topic.options.depth
        if depth == AUTO:
            depth = 1 if topic.latched else self._settings.depth
        asked = topic.options.reliability
        qos = Qos(None if asked == AUTO else asked, "transient_local" if topic.latched else "volatile", depth)
        name = self.heard.name(key)
        for (src_id, _), other in list(self._outputs.items()):
            if src_id == key[0] and other is not output and other.publisher is not None and other.name == name:
                self.release([other])  # the same topic with its type before, or for another robot
                before, other.publisher = other.publisher, None
                if (other.topic.type_name, other.topic.options) == (topic.type_name, topic.options):
                    output.name, output.publisher = name, before
                    return before
                before.close()
        output.name = name
        publisher = output.publisher = self._graph.advertise(name, topic.type_name, qos)
        if self.running and self._graph.settling_s and not topic.latched:
            output.early = EarlyMessages(publisher, self._graph.settling_s, self._clock())
            with self._lock:
                self.opening.add(output)
                self.due.notify_all()
        return publisher

    def _clock_of(self, src_id: int) -> ClockOffset | None:
        """The clock of a robot's stamps beside this one's; None where it is not known."""
        if self._sim_time:
            return None  # all of them follow one /clock
        with self._lock:
            known = self._end.clock_of(src_id, self._clock())
        return self.other_clocks(src_id) if known is None else known

    def _moved(self, stamps: MovedStamps, type_name: str, payload: bytes, clock: ClockOffset | None) -> bytes:
        """A message with stamps of this robot's clock, as far as the other one's is known."""
        if clock is None:
            self._failures.counters["stamps_not_moved"] += 1
            return payload
        return stamps.apply(type_name, payload, -clock.ahead_s)

    def _measure(self, output: Output, payload: bytes, clock: ClockOffset | None) -> float | None:
        """Note the latency of a message, and return it where it is known, s; the caller holds the lock.

        :param clock: of its stamp
        """
        latency = self._latencies.of(payload)
        if latency is None:
            return None
        by = None if clock is None else clock.jumps
        if output.latency is None:
            self._forget_the_gone()
            output.latency = LatencyWindow()
        elif output.measured_by != by:
            output.latency.forget()
        output.measured_by = by
        known = None if clock is None else latency + clock.ahead_s
        output.latency.add(latency if known is None else known)
        return known

    def _forget_the_gone(self) -> None:
        """Free the latencies of senders that the receiver no longer knows: 0.3 MB per topic."""
        for (src_id, _), output in list(self._outputs.items()):
            if not self._end.knows(src_id):
                output.latency = None
