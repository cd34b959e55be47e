"""ROS 2 bags (MCAP and sqlite3) as a source and as a sink.

Invariant: a bag being read is a finite graph of publishers: one thread plays the topics subscribed before ``start()``
in recorded order, and a blocking callback delays it. A bag being written is a graph with one subscriber of all topics.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal

from gr_ros2.core.errors import BagError, ConfigError, MiddlewareError
from gr_ros2.core.names import first
from gr_ros2.middleware import ros_graph
from gr_ros2.middleware.adapt import offered
from gr_ros2.middleware.bag_files import BagContents, BagMessage, bag_contents, bag_definitions, bag_topics, read_bag
from gr_ros2.middleware.bag_recorder import BagChannel, BagRecorder
from gr_ros2.middleware.base import MessageCallback, Middleware, Publisher, Qos, Subscription, TopicInfo
from gr_ros2.settings.fields import AUTO, Auto
from gr_ros2.settings.registry import normalize_type

__all__ = ["BagMessage", "BagMiddleware", "BagPublisher", "bag_definitions", "bag_topics", "read_bag"]

_log = logging.getLogger(__name__)


class BagPublisher(Publisher):
    """A topic being recorded."""

    def __init__(self, recorder: BagRecorder, channel: BagChannel) -> None:
        self._recorder = recorder
        self._channel = channel
        self._closed = False

    def publish(self, payload: bytes) -> None:
        """Record a message, stamped with the wall clock."""
        self.publish_at(payload, time.time_ns())

    def publish_at(self, payload: bytes, stamp_ns: int) -> None:
        """Record a message.

        :param stamp_ns: when it was received, ns since 1970, >= 0
        :raises MiddlewareError: once closed
        :raises BagError: the file cannot be written
        """
        if self._closed:
            raise MiddlewareError(f"publish on {self._channel.topic}: the publisher is closed")
        if not 0 <= stamp_ns < 2**63:
            raise ConfigError(f"stamp_ns = {stamp_ns} on {self._channel.topic}: ns since 1970, 0..2^63 - 1")
        self._recorder.write(self._channel, stamp_ns, bytes(payload))

    def matched(self) -> int:
        """1: the file."""
        return 0 if self._closed or self._recorder.closed else 1

    def close(self) -> None:
        self._closed = True


class BagSubscription(Subscription):
    """A topic being played."""

    def __init__(self, topic: str, callback: MessageCallback, publishers: Sequence[Qos]) -> None:
        super().__init__()
        self.topic = topic
        self.callback = callback
        self.closed = False
        self._publishers = publishers
        self.found(publishers)

    def matched(self) -> int:
        """Number of recorded publishers of this topic."""
        return 0 if self.closed else len(self._publishers)

    def close(self) -> None:
        self.closed = True
        self.wait_for_callback()


class BagMiddleware(Middleware):
    """A bag as a graph: one that plays, or one that records.

    :param path: reading, a bag folder or a bare ``.mcap`` or ``.db3`` file; writing, a folder that does not exist yet
    :param speed: times the recorded speed; 0 = as fast as the callbacks return
    :param mode: ``read`` or ``write``
    :param storage: of a bag being written: ``mcap`` or ``sqlite3``
    :param definitions: ``.msg`` texts by type name, written into the bag; other types have the definition of ROS
    :param lossless: of a bag being written: publishing waits for a slow disk; otherwise messages that the disk cannot
        take are dropped and counted as ``not_recorded:/topic``
    :param domain_id: accepted but not used, because a bag has no domain, so that all back-ends have the same arguments;
        likewise node_name and namespace
    :raises ConfigError: a setting is out of range
    :raises BagError: the file is missing, damaged or not a bag; or it exists already
    """

    name = "bag"

    def __init__(
        self,
        *,
        path: str | Path,
        speed: float = 1.0,
        mode: Literal["read", "write"] = "read",
        storage: Literal["mcap", "sqlite3"] = "mcap",
        definitions: Mapping[str, str] | None = None,
        lossless: bool = True,
        domain_id: int | Auto = AUTO,  # noqa: ARG002
        node_name: str = "gr_ros2",  # noqa: ARG002
        namespace: str = "/",  # noqa: ARG002
    ) -> None:
        super().__init__()
        if not 0 <= speed < float("inf"):
            raise ConfigError(f"speed = {speed!r}: must be a factor of 0 (as fast as possible) or more")
        if mode not in ("read", "write"):
            raise ConfigError(f"mode = {mode!r}: read or write")
        self.path = Path(path)
        self.speed = speed
        self._stop = threading.Event()
        self._finished = False
        self._error: BagError | None = None
        self._starting = threading.Lock()
        self._thread: threading.Thread | None = None
        self._subscriptions: dict[str, list[BagSubscription]] = {}
        self._recorder = (
            BagRecorder(self.path, storage, definitions or {}, self.count, lossless=lossless)
            if mode == "write"
            else None
        )
        self._contents = bag_contents(self.path) if mode == "read" else BagContents(self.path, {}, {}, ())
        for line in self._contents.differences:
            self.count("bag_differs", line)

    # Reading

    def subscribe(
        self,
        topic: str,
        type_name: str,
        qos: Qos,  # noqa: ARG002 - a file fits any QoS
        callback: MessageCallback,
    ) -> BagSubscription:
        """Subscribe a topic of the bag, before :meth:`start`.

        :raises ConfigError: the bag has the topic with another type, or the topic cannot be carried
        """
        topic, type_name = ros_graph.check_topic(topic), normalize_type(type_name)
        self._reading(f"subscribe {topic}")
        self._contents.check(topic, type_name)
        topics = self._contents.topics
        if topic not in topics:
            _log.warning("bag %s: has no topic %s; it has %s", self.path, topic, ", ".join(first(topics)) or "none")
        subscription = BagSubscription(topic, callback, topics[topic].info.publishers if topic in topics else ())
        with self._starting:
            if self._thread is not None:
                raise MiddlewareError(f"subscribe {topic}: bag {self.path} is playing; subscribe before start()")
            self._subscriptions.setdefault(topic, []).append(subscription)
        return subscription

    def discover(self) -> list[TopicInfo]:
        """The topics of the bag that is read, with the QoS offered when it was recorded; empty for a bag being written.

        Topics that cannot be carried are left out.
        """
        return [topic.info for topic in self._contents.topics.values()]

    def start(self) -> None:
        """Start to play; the second call does nothing. A bag being written needs no start."""
        with self._starting:
            if self._recorder is None and self._thread is None and not self._stop.is_set():
                self._thread = threading.Thread(target=self._run, name=f"bag-{self.path.name}", daemon=True)
                self._thread.start()

    @property
    def finished(self) -> bool:
        """True once the last callback has returned, or playing has failed (see :attr:`error`)."""
        return self._finished

    @property
    def error(self) -> BagError | None:
        """The error that ended playing or recording early, None without one."""
        return self._error if self._recorder is None else self._recorder.error

    def _run(self) -> None:
        try:
            self._play()
        except BagError as error:
            self._error = error
            self.count("bag_failed", str(error))
        finally:
            self._finished = True

    def _play(self) -> None:
        start: tuple[float, int] | None = None
        for message in read_bag(self.path, self._subscriptions):
            if self.speed:
                start = start or (time.monotonic(), message.stamp_ns)
                due = start[0] + (message.stamp_ns - start[1]) * 1e-9 / self.speed
                self._stop.wait(max(0.0, due - time.monotonic()))
            for subscription in self._subscriptions[message.topic]:
                with subscription.calling:
                    if self._stop.is_set():
                        return
                    if not subscription.closed:
                        self.deliver(message.topic, subscription.callback, message.payload)

    # Writing

    def advertise(self, topic: str, type_name: str, qos: Qos) -> BagPublisher:
        """Write a topic, with the definition of its type: from ``definitions``, or that of ROS.

        :raises ConfigError: the topic is being written with another type
        """
        topic, type_name = ros_graph.check_topic(topic), normalize_type(type_name)
        recorder = self._writing(f"advertise {topic}")
        return BagPublisher(recorder, recorder.channel(topic, type_name, offered(qos)))

    # Both

    def close(self) -> None:
        """Stop playing, or finish the file.

        :raises BagError: what was published could not be written
        """
        self._stop.set()
        if self._recorder is not None:
            self._recorder.close()
        if self._thread is not None:
            self.wait_for_thread(self._thread)

    def _reading(self, what: str) -> None:
        if self._recorder is not None:
            raise MiddlewareError(f"{what}: bag {self.path} is being written; open it with mode='read'")
        if self._stop.is_set():
            raise MiddlewareError(f"{what}: the middleware is closed")

    def _writing(self, what: str) -> BagRecorder:
        if self._recorder is None:
            raise MiddlewareError(f"{what}: bag {self.path} is being read; open it with mode='write'")
        if self._stop.is_set():
            raise MiddlewareError(f"{what}: the middleware is closed")
        return self._recorder
