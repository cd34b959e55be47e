"""What a robot takes from its ROS graph: the topics, with the QoS of their publishers.

Invariants: a callback of the middleware blocks only with ``backpressure``. Each type of a topic has its own topic id.
"""

from __future__ import annotations

import logging
import threading
from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any

from gr_ros2.codecs.frames import FrameSender, Job
from gr_ros2.codecs.messages import GRID_UPDATE
from gr_ros2.core.errors import CodecError, ConfigError
from gr_ros2.gr.frame_ids import STATIC_DEPTH, TF_TYPE, StaticTransforms
from gr_ros2.gr.live_end import LiveEnd
from gr_ros2.gr.loops import LOOP_GUARD
from gr_ros2.link.endpoint import Endpoint, OpenMessages, check_live_options
from gr_ros2.link.fates import Fate
from gr_ros2.link.queues import PublisherQos
from gr_ros2.middleware import Middleware, Qos, Subscription, TopicInfo
from gr_ros2.middleware.adapt import agreed
from gr_ros2.middleware.type_descriptions import Described
from gr_ros2.settings.config import SendOptions
from gr_ros2.settings.fields import AUTO
from gr_ros2.settings.registry import DEFAULT_OPTIONS, NewTopic, Registry, Topic, normalize_type, options_of
from gr_ros2.settings.robot import RobotConfig

Takes = Callable[[SendOptions], bool]
_PATIENCE_S = 1.0
"""s that closing waits for a picture that is being encoded."""


class FrameWorker:
    """The thread that encodes the pictures of a link when the air is about to be free for them. It is there only where
    a topic is sent as frames; nothing is encoded with the endpoint's lock held, nor on the thread that sends.

    :param live: the endpoint; its lock is held by whoever calls ``look``
    :param clock: s, monotonic
    """

    def __init__(
        self, sender: FrameSender, live: LiveEnd[Endpoint], clock: Callable[[], float], log: logging.Logger
    ) -> None:
        self._sender, self._live, self._clock, self._log = sender, live, clock, log
        self._work = threading.Condition(live.lock)
        self._jobs: deque[Job] = deque()
        self._running = True
        self._thread: threading.Thread | None = None
        live.look = self.look

    def look(self) -> None:
        """Find what is to be encoded now. Called with the lock held, after anything that may change it."""
        while (job := self._sender.next(self._clock())) is not None:
            self._jobs.append(job)
            if self._thread is None and self._running:
                self._thread = threading.Thread(target=self._run, name="gr-ros2-frames", daemon=True)
                self._thread.start()
            self._work.notify()

    def close(self) -> None:
        """Encode nothing more. Called without the lock."""
        with self._live.lock:
            self._running, self._live.look = False, lambda: None
            self._sender.end()
            self._work.notify()
        if self._thread is not None:
            self._thread.join(_PATIENCE_S)

    def _run(self) -> None:
        while True:
            with self._live.lock:
                while self._running and not self._jobs:
                    self._work.wait()
                if not self._running:
                    return
                job = self._jobs.popleft()
            try:
                made = job.run()
            except Exception as error:  # noqa: BLE001 - an exception would end all pictures
                self._log.exception("a picture was not encoded")
                made = CodecError(f"image: {error}")
            with self._live.lock:
                self._sender.done(job, made, self._clock())
                self.look()
                self._live.wake()


def everything(_options: SendOptions) -> bool:
    """Every topic."""
    return True


class Subscriptions:
    """The topics that a robot sends, and the services that it offers.

    :param registry: what it sends and offers, from which ``config.topics`` chooses, with its own options
    :param graph: the robot's participant on its ROS graph
    :param live: endpoint that takes the messages
    :param clock: s, monotonic
    :param backpressure: holds the middleware back while a queue is full
    :param counters: counts ``held_back_at_close``, and what static transforms count
    :param takes: which topics it sends, by their options
    :ivar registry: all topics so far
    :ivar frames: the topics that are sent as frames; None in a version, or with a setting, without them
    :ivar options: the options of single topics, by name
    :ivar space: notified when a message that is held back may be submitted; uses the lock of ``live``
    :ivar subscribed: topics by their absolute names on the ROS graph, as they were subscribed. The mapping is replaced
        as a whole when a topic is added
    :ivar services: the same for the services that other robots may call
    """

    def __init__(
        self,
        registry: Registry,
        config: RobotConfig,
        graph: Middleware,
        live: LiveEnd[Endpoint],
        *,
        clock: Callable[[], float],
        counters: Counter[str],
        log: logging.Logger,
        backpressure: bool = False,
        takes: Takes = everything,
    ) -> None:
        self._given, self.takes = registry, takes
        self.options: Mapping[str, SendOptions] = config.options
        self.registry = registry = registry.with_options(self.options)
        self.space = threading.Condition(live.lock)
        self._config, self._graph, self._live, self._backpressure = config, graph, live, backpressure
        self._messages = live.endpoint.messages
        self._clock, self._counters, self._log = clock, counters, log
        self._closed = False
        static = [topic for topic in registry if topic.latched and topic.type_name == TF_TYPE]
        self._static = {topic.topic_id: StaticTransforms(counters) for topic in static}
        self._subscriptions: dict[int, Subscription] = {}
        frames = live.endpoint.frames if config.compression else None
        self.frames = None if frames is None else FrameSender(frames)
        self._worker = None if self.frames is None else FrameWorker(self.frames, live, clock, log)
        self._moved: dict[int, Topic] = {}
        """As what messages leave now, by the topic ids that were subscribed, where options have changed."""
        chosen = registry.chosen(config.words) if registry else []
        self.subscribed = {
            topic.on_graph(config.namespace): topic for topic in chosen if topic.is_topic and takes(topic.options)
        }
        self.services = {
            topic.on_graph(config.namespace): topic for topic in chosen if topic.is_service and takes(topic.options)
        }

    def open(self) -> None:
        """Subscribe to all topics.

        :raises GrRos2Error: when a topic cannot be subscribed
        """
        self._guard_loops()
        for topic in self.subscribed.values():
            self._code(topic)
        for name, topic in self.subscribed.items():
            self._subscribe(name, topic)

    def close(self) -> None:
        """Take no further messages. Idempotent."""
        with self._live.lock:
            self._closed = True
            self.space.notify_all()
        for subscription in self._subscriptions.values():
            subscription.close()
        if self._worker is not None:
            self._worker.close()
        with self._live.lock:
            self.take_losses()
        self._subscriptions.clear()
        LOOP_GUARD.remove(self)

    def unmatched(self) -> list[str]:
        """Names, on the ROS graph, of the topics without a publisher."""
        subscriptions = self._subscriptions
        waiting = {name: subscriptions.get(topic.topic_id) for name, topic in self.subscribed.items()}
        return [name for name, end in waiting.items() if end is not None and not end.matched()]

    def take_losses(self) -> None:
        """Count the messages that the ROS graph lost before they arrived here. Called with the lock held."""
        for topic_id, subscription in self._subscriptions.items():
            self._messages.ledger.missed(topic_id, subscription.lost)

    def stats(self) -> dict[str, dict[str, Any]]:
        """The counters of each topic, by its name on the ROS graph. Called with the lock held."""
        self.take_losses()
        stats, queued = self._live.endpoint.sent, self._messages.queued()
        ids: dict[str, list[int]] = {}
        for topic in self.registry:
            if topic.is_topic:
                ids.setdefault(topic.name, []).append(topic.topic_id)
        now = {topic.topic_id: self._now(topic.topic_id) for topic in self.subscribed.values()}
        return {
            name: {
                "topic_id": now[topic.topic_id],
                "type": topic.type_name,
                "types": len({self.registry[topic_id].type_name for topic_id in ids[topic.name]}),
                "submitted": sum(stats.submitted[topic_id] for topic_id in ids[topic.name]),
                Fate.LOST_ON_GRAPH.value: sum(stats.missed[topic_id] for topic_id in ids[topic.name]),
                "sent": sum(stats.sent[topic_id] for topic_id in ids[topic.name]),
                "arrived": sum(stats.ended[topic_id, True] for topic_id in ids[topic.name]),
                "unconfirmed": sum(stats.ended[topic_id, False] for topic_id in ids[topic.name]),
                "frames": self.frames and self.frames.stats(now[topic.topic_id], self._clock()),
                "queued": sum(queued[topic_id] for topic_id in ids[topic.name]),
                "queue": self._messages.queue(now[topic.topic_id])[0],
                "queue_depth": self._messages.depth(now[topic.topic_id]),
                "refused": {
                    reason: sum(stats.refused[topic_id, reason] for topic_id in ids[topic.name])
                    for reason in sorted({why for topic_id, why in stats.refused if topic_id in ids[topic.name]})
                },
            }
            for name, topic in self.subscribed.items()
        }

    def named(self) -> list[tuple[str, Topic]]:
        """All topics so far, with their names on the ROS graph: one for each type, and for each robot it was for."""
        names = {topic.name: name for name, topic in self.subscribed.items()}
        return [(names[topic.name], topic) for topic in self.registry if topic.is_topic and topic.name in names]

    def _now(self, topic_id: int) -> int:
        """The topic id under which messages of a subscription leave now."""
        return self._moved[topic_id].topic_id if topic_id in self._moved else topic_id

    def _code(self, topic: Topic) -> None:
        if self.frames is not None and topic.is_topic:
            self.frames.add(topic)

    def _guard_loops(self) -> None:
        LOOP_GUARD.add_source(self, self._graph, [*self.subscribed, *self.services])

    def _subscribe(self, name: str, topic: Topic) -> None:
        options = topic.options
        depth = self._config.graph.depth if options.depth == AUTO else options.depth
        if topic.topic_id in self._static and depth:
            depth = max(depth, STATIC_DEPTH)
        reliability = None if options.reliability == AUTO else options.reliability
        durability = None if options.durability == AUTO else options.durability
        qos = Qos(reliability, durability, depth)
        callback = partial(self._take, topic.topic_id)
        subscription = self._graph.subscribe(name, topic.type_name, qos, callback)
        self._subscriptions = {**self._subscriptions, topic.topic_id: subscription}
        subscription.follow(partial(self._follow, topic))

    def _adapt(self, topic: Topic, offers: Sequence[Qos]) -> bool:
        """Tell the endpoint the QoS of a topic's publishers; return whether its queue changed. The lock is held."""
        qos = agreed(offers)
        publishers = PublisherQos(
            reliable=qos.reliability != "best_effort",
            latched=all(offer.durability == "transient_local" for offer in offers),
            depth=0 if topic.type_name == GRID_UPDATE else qos.depth,  # each is of use with all before it
            lifespan_s=qos.lifespan_s,
            period_s=qos.deadline_s,
            count=len(offers),
            keeps=min(sum(max(offer.depth, 1) for offer in offers), 255),
        )
        return self._messages.follow(self._now(topic.topic_id), publishers)

    def _follow(self, topic: Topic, offers: Sequence[Qos]) -> None:
        """Adapt the queue of a topic to the QoS that its publishers offer, where the queue is not configured."""
        with self._live.lock:
            changed = self._adapt(topic, offers)
            if self.frames is not None:
                now = self._moved.get(topic.topic_id, topic)
                latched = all(offer.durability == "transient_local" for offer in offers)
                if latched and now.topic_id not in self.frames:
                    self.frames.add(now, latched=now.options.durability != "volatile")
                self.frames.follow(now.topic_id, len(offers))
            policy, deadline_s = self._messages.queue(self._now(topic.topic_id))
        if changed:
            limit = f", stale after {deadline_s * 1e3:g} ms" if deadline_s else ""
            self._log.info("topic %s: queue %s%s, as its publishers' QoS has it", topic.name, policy, limit)

    def _take(self, topic_id: int, payload: bytes) -> None:
        """Accept a message of the ROS graph, in a thread of the middleware."""
        now_id = self._now(topic_id)
        changed = None if self.frames is None else self.frames.changed(now_id, payload)
        plain = topic_id not in self._static and (self.frames is None or now_id not in self.frames)
        prepared = self._messages.prepare(now_id, payload) if plain else None  # the sending thread goes on meanwhile
        with self._live.lock:
            now_id = self._now(topic_id)
            frames = self.frames if self.frames is not None and now_id in self.frames else None
            held_back = self._backpressure and frames is None and changed is None
            while held_back and not self._closed and not self._messages.has_space(now_id):
                self.space.wait()
                now_id = self._now(topic_id)
            if self._closed:
                self._counters["held_back_at_close"] += 1
                return
            if changed is not None and self.frames is not None:
                self.frames.take(changed, self._clock())
                self._live.look()
                return
            subscription = self._subscriptions.get(topic_id)
            if subscription is not None and subscription.lost:
                self._messages.ledger.missed(topic_id, subscription.lost)
            waited_s, publisher = (0.0, None) if subscription is None else (subscription.waited_s, subscription.source)
            if frames is not None:
                frames.offer(now_id, payload, self._clock(), publisher)
                self._live.look()
                return
            # A late robot gets only the newest message of a topic. So this message must hold all static transforms.
            static = self._static.get(topic_id)
            whole = None if static is None else static.union(payload)
            self._messages.submit(
                now_id, whole or payload, self._clock(), waited_s=waited_s, publisher=publisher, prepared=prepared
            )
            self._live.wake()


class OpenSubscriptions(Subscriptions):
    """Those of a robot that announces its topics, so that these may change while it runs."""

    _messages: OpenMessages

    def types(self) -> list[tuple[str, str]]:
        """Name on the ROS graph and type of each topic."""
        return [(name, topic.type_name) for name, topic in self.subscribed.items()]

    def learn(self, described: Described) -> None:
        """Code messages of a type by the definition that a node has given."""
        with self._live.lock:
            self._messages.learn(described.type_name, described.types)
            self._live.rouse()

    def change(self, options: Mapping[str, SendOptions]) -> None:
        """Use other options of single topics from now on, all or none. Called with the lock held.

        :raises ConfigError: for an option that cannot change, or one robot more than the table has rows for
        """
        before, after = self._given.with_options(self.options), self._given.with_options(options)
        changed = {}
        for topic in (*self.subscribed.values(), *self.services.values()):
            given = topic.topic_id < len(after)
            old = before[topic.topic_id].options if given else options_of(topic.name, self.options, DEFAULT_OPTIONS)
            new = after[topic.topic_id].options if given else options_of(topic.name, options, DEFAULT_OPTIONS)
            if new != old:
                if topic.is_service:
                    raise ConfigError(f"{topic.name}: the options of a service change with a restart only")
                check_live_options(topic.name, old, new)
                if self.frames is not None:
                    self.frames.check(self._now(topic.topic_id), new)
                changed[topic.topic_id] = new
        for topic_id, new in changed.items():
            self._change(topic_id, new)
        self.options = options

    def add_services(self, found: Mapping[str, NewTopic]) -> dict[str, Topic]:
        """Announce services, and the topics of actions.

        :param found: by names on the ROS graph; some may have been announced before
        :return: the services among them, by names on the ROS graph
        :raises ConfigError: for more than a link carries
        """
        with self._live.lock:
            known = {(topic.name, topic.type_name) for topic in self.registry}
            if new := [row for row in found.values() if row[:2] not in known]:
                self.registry = self._messages.add(new)
            rows = {(topic.name, topic.type_name): topic for topic in self.registry}
            added = {name: rows[row[:2]] for name, row in found.items()}
            services = {name: topic for name, topic in added.items() if topic.is_service}
            topics = {name: topic for name, topic in added.items() if topic.is_topic}
            self.services = {**self.services, **services}
            self.subscribed = {**self.subscribed, **topics}
        self._guard_loops()
        for name, topic in topics.items():
            self._subscribe(name, topic)
        return services

    def add(self, row_name: str, info: TopicInfo, options: SendOptions | None = None) -> None:
        """Announce a topic of the graph, and subscribe it. It may be sent already, with a type that has no publisher
        any more.

        :param options: None: those of the settings
        :raises ConfigError: for a topic that cannot be sent, such as one more than a link carries
        """
        options = options or options_of(row_name, self.options, DEFAULT_OPTIONS)
        type_name = normalize_type(info.type_name)
        with self._live.lock:
            before = self.subscribed.get(info.topic)
            known = [topic for topic in self.registry if (topic.name, topic.type_name) == (row_name, type_name)]
            if not known:
                self.registry = self._messages.add([(row_name, type_name, options)])
                known = [self.registry[-1]]
            topic = known[0]
            self._change(topic.topic_id, options)
            self._code(topic)
            self._adapt(topic, info.publishers)
            if topic.type_name == TF_TYPE and all(offer.durability == "transient_local" for offer in info.publishers):
                self._static[topic.topic_id] = StaticTransforms(self._counters)
            self.subscribed = {**self.subscribed, info.topic: topic}
            self._live.rouse()
        self._guard_loops()
        if before is None:
            self._log.info("topic %s (%s) of the ROS graph is sent", info.topic, topic.type_name)
        else:
            self._log.warning("topic %s is %s now, was %s", info.topic, topic.type_name, before.type_name)
            self._unsubscribe(before)
        self._subscribe(info.topic, topic)

    def use(self, name: str, options: SendOptions) -> None:
        """Use other options of a topic that is sent, by its name on the ROS graph."""
        with self._live.lock:
            self._change(self.subscribed[name].topic_id, options)
            self._live.rouse()

    def remove(self, names: Iterable[str]) -> None:
        """Send these no more, by their names on the ROS graph; their topic ids stay theirs."""
        for name in names:
            with self._live.lock:
                topic = self.subscribed.get(name)
                self.subscribed = {other: kept for other, kept in self.subscribed.items() if other != name}
                self.services = {other: kept for other, kept in self.services.items() if other != name}
            if topic is not None:
                self._unsubscribe(topic)
                with self._live.lock:
                    self._messages.stop(self._now(topic.topic_id))
                    if self.frames is not None:
                        self.frames.stop(self._now(topic.topic_id))
                self._log.info("topic %s is not sent any more: nobody wants it", name)
        self._guard_loops()

    def returns(self, names: Iterable[str]) -> bool:
        """Whether a topic or service of the ROS graph has come by radio."""
        return any(LOOP_GUARD.returns(self._graph, name) for name in names)

    def _change(self, topic_id: int, options: SendOptions) -> None:
        before = self.registry[self._now(topic_id)]
        self.registry, after = self._messages.change(before.topic_id, options)
        self._moved[topic_id] = after
        if self.frames is not None and topic_id not in self._static:
            self.frames.change(before, after)

    def _unsubscribe(self, topic: Topic) -> None:
        """Take no further messages of a topic id, and keep none for robots that join late."""
        subscriptions = dict(self._subscriptions)
        subscriptions.pop(topic.topic_id).close()
        with self._live.lock:
            self.take_losses()
            self._subscriptions = subscriptions
            self._messages.forget_kept(self._now(topic.topic_id))
            if self.frames is not None:
                self.frames.forget(self._now(topic.topic_id))
