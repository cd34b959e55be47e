"""The programs of the robots: each plays a recording, or records what arrives, or both.

Invariants: between contenders, the programs differ only in the network that they join. A message counts as sent at its
due time in the recording, so a network that delays the sending program gains nothing. Times are s of the machine's
monotonic clock.
"""

from __future__ import annotations

import json
import os
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from gr_ros2.core.closing import Closing
from gr_ros2.middleware import Middleware, Publisher, Qos, Subscription, join_graph
from gr_ros2.middleware.bag import BagMiddleware
from gr_ros2.middleware.base import MessageCallback, Reliability
from gr_ros2_lab.race.contenders import ADDRESSES, QUEUE, Contender, cyclone_uri, fast_profiles, zenoh_config
from gr_ros2_lab.race.fast import FastDds
from gr_ros2_lab.race.links import DEPTH, DOMAINS
from gr_ros2_lab.race.tun import INTERFACE

_ROS_DEPTH = 10
"""Messages that ROS 2 nodes keep by default."""
_DOMAIN = 0
_POLL_S = 0.02
_LATE_S = 1.0
"""s that the player of a recording may be late, because the computer is busy."""


@dataclass(frozen=True)
class RaceTopic:
    """A topic as the network knows it."""

    name: str
    type_name: str
    qos: Qos | None = None
    """of its publisher; None: the contender's"""


@dataclass(frozen=True)
class Seat:
    """The place of a program.

    :param number: of the robot, from 0
    :param robots: how many there are
    :param shared: all are on one channel and hear multicast; otherwise the first sends to the second
    """

    number: int
    robots: int = 2
    shared: bool = False


@dataclass(frozen=True)
class Playback:
    """What a program plays.

    :param recorded: name of the topic in the bag
    :param topic: as which it is published
    :param messages: number of messages to publish
    :param duration_s: length of the recording, s; a message that the network delays by more than a second beyond this
        time is never published
    :param phase_s: s from the beginning of all recordings to the first message
    """

    bag: Path
    recorded: str
    topic: RaceTopic
    messages: int
    duration_s: float
    phase_s: float = 0.0


class _Player(Closing):
    """Publishes the messages of one recording at their times."""

    def __init__(self, plays: Playback) -> None:
        self.plays = plays
        self._bag = BagMiddleware(path=plays.bag)
        self._publisher: Publisher | None = None
        self._published = 0
        self.t_first = float("nan")
        """When the first message was due, s monotonic."""

    def play(self, publisher: Publisher) -> None:
        """Begin now."""
        self._publisher = publisher
        self._bag.subscribe(self.plays.recorded, self.plays.topic.type_name, Qos(), self._publish)
        self._bag.start()

    @property
    def over(self) -> bool:
        """Whether it has published all."""
        return self._published >= self.plays.messages

    def _publish(self, payload: bytes) -> None:
        assert self._publisher is not None
        if not self._published:
            self.t_first = time.monotonic()
        if not self.over:
            self._publisher.publish(payload)
            self._published += 1

    def close(self) -> None:
        self._bag.close()


class Network(ABC):
    """The connection of one end to the network that carries the messages."""

    @abstractmethod
    def advertise(self, topic: RaceTopic) -> Publisher:
        """Create a publisher."""

    @abstractmethod
    def subscribe(self, topic: RaceTopic, callback: MessageCallback) -> Subscription:
        """Create a subscription."""

    @abstractmethod
    def close(self) -> None:
        """Leave the network with all publishers and subscriptions."""


class RosNetwork(Network):
    """A ROS 2 node.

    :param qos: QoS of the publisher; a subscription has a larger depth, so that it loses no message on a busy computer
    """

    def __init__(self, graph: Middleware | FastDds, qos: Qos) -> None:
        self._graph, self._qos = graph, qos

    def advertise(self, topic: RaceTopic) -> Publisher:
        return self._graph.advertise(topic.name, topic.type_name, topic.qos or self._qos)

    def subscribe(self, topic: RaceTopic, callback: MessageCallback) -> Subscription:
        qos = topic.qos or replace(self._qos, depth=DEPTH)
        return self._graph.subscribe(topic.name, topic.type_name, qos, callback)

    def close(self) -> None:
        self._graph.close()


class ZenohNetwork(Network):
    """A Zenoh session.

    :param config: settings as in Zenoh's configuration file
    :param changes: settings by path
    :param priority: of what is volatile: a name in Zenoh's ``Priority``
    :param congestion: what a publisher does when its queue is full: a name in Zenoh's ``CongestionControl``
    """

    def __init__(
        self,
        config: dict[str, Any],
        changes: dict[str, Any],
        *,
        reliable: bool,
        congestion: str,
        priority: str = "DATA",
    ) -> None:
        import zenoh  # imported here, because the other contenders do not need it

        self._reliability = zenoh.Reliability.RELIABLE if reliable else zenoh.Reliability.BEST_EFFORT
        self._congestion = getattr(zenoh.CongestionControl, congestion)
        self._priority = getattr(zenoh.Priority, priority)
        made = zenoh.Config.from_json5(json.dumps(config))
        for path, value in changes.items():
            made.insert_json5(path, json.dumps(value))
        self._session: Any = zenoh.open(made)

    def advertise(self, topic: RaceTopic) -> Publisher:
        """As rmw_zenoh does: what is latched is kept in a cache, which a late subscriber asks for."""
        options = {"congestion_control": self._congestion, "reliability": self._reliability}
        if topic.qos is not None and topic.qos.durability == "transient_local":
            import zenoh
            from zenoh import ext

            options["congestion_control"] = zenoh.CongestionControl.BLOCK
            made = ext.declare_advanced_publisher(
                self._session,
                topic.name.lstrip("/"),
                cache=ext.CacheConfig(topic.qos.depth),
                publisher_detection=True,
                **options,
            )
        else:
            made = self._session.declare_publisher(topic.name.lstrip("/"), priority=self._priority, **options)
        return _PlainZenohPublisher(made, self._session)

    def subscribe(self, topic: RaceTopic, callback: MessageCallback) -> Subscription:
        def take(sample: Any) -> None:
            callback(sample.payload.to_bytes())

        if topic.qos is not None and topic.qos.durability == "transient_local":
            from zenoh import ext

            history = ext.HistoryConfig(detect_late_publishers=True)
            made = ext.declare_advanced_subscriber(self._session, topic.name.lstrip("/"), take, history=history)
        else:
            made = self._session.declare_subscriber(topic.name.lstrip("/"), take)
        return _PlainZenohSubscription(made, self._session)

    def close(self) -> None:
        import zenoh

        with suppress(zenoh.ZError):  # the other end, to which it says farewell, is gone or not reached
            self._session.close()


class _PlainZenohPublisher(Publisher):
    def __init__(self, publisher: Any, session: Any) -> None:
        self._publisher, self._session = publisher, session

    def publish(self, payload: bytes) -> None:
        self._publisher.put(payload)

    def matched(self) -> int:
        """Sessions found. Over multicast, Zenoh does not say which of them subscribe, and sends in any case."""
        found = self._session.info.transports()
        heard = self._publisher.matching_status.matching or all(transport.is_multicast for transport in found)
        return len(found) if heard else 0

    def close(self) -> None:
        self._publisher.undeclare()


class _PlainZenohSubscription(Subscription):
    def __init__(self, subscriber: Any, session: Any) -> None:
        super().__init__()
        self._subscriber, self._session = subscriber, session

    def matched(self) -> int:
        return len(self._session.info.transports())

    def close(self) -> None:
        self._subscriber.undeclare()


def join(contender: Contender, seat: Seat, topics: Sequence[RaceTopic]) -> Network:
    """Connect a program to the network of a contender.

    :param topics: those that it will publish or hear
    :raises MiddlewareError: when that fails
    """
    settings = {key: value for key, value in contender.settings.items() if key != QUEUE}
    if contender.stack == "zenoh":
        latched = any(topic.qos is not None and topic.qos.durability == "transient_local" for topic in topics)
        transport, how = settings.pop("transport"), {"congestion": settings.pop("congestion")}
        if priority := settings.pop("priority", ""):
            how["priority"] = priority
        config, changes = zenoh_config(transport, seat.number, seat.robots, INTERFACE, settings)
        stamped = latched or not settings  # rmw_zenoh stamps everything
        changes = {**changes, "timestamping/enabled": stamped}
        return ZenohNetwork(config, changes, reliable=contender.reliable, **how)
    if contender.stack == "gr-ros2":  # the local graphs lose nothing; the radio is between them
        return RosNetwork(_cyclone(DOMAINS[seat.number], localhost_only=True), Qos("reliable", "volatile", DEPTH))
    reliability: Reliability = "reliable" if contender.reliable else "best_effort"
    qos, peer = (
        Qos(reliability, "volatile", settings.pop("depth", _ROS_DEPTH)),
        "" if seat.shared else ADDRESSES[1 - seat.number],
    )
    if contender.stack == "fast":
        return RosNetwork(FastDds(_DOMAIN, fast_profiles(ADDRESSES[seat.number], peer, settings)), qos)
    os.environ["CYCLONEDDS_URI"] = cyclone_uri(INTERFACE, peer, settings)
    return RosNetwork(_cyclone(_DOMAIN, localhost_only=False), qos)


def _cyclone(domain_id: int, *, localhost_only: bool) -> Middleware:
    return join_graph("dds", domain_id=domain_id, node_name="race", localhost_only=localhost_only)


class RaceProgram(Closing):
    """A program of a robot.

    :param plays: what it publishes; none: it only listens
    """

    def __init__(self, contender: Contender, seat: Seat, plays: Sequence[Playback] = ()) -> None:
        self._contender, self._seat = contender, seat
        self._players = [_Player(playback) for playback in plays]
        self._network: Network | None = None
        self._publishers: list[Publisher] = []
        self._subscriptions: list[Subscription] = []
        self._heard: list[list[tuple[float, bytes]]] = []
        self._lock = threading.Lock()

    def connect(self, hears: Sequence[RaceTopic] = ()) -> float:
        """Join the network. Return the time at which joining began, s monotonic.

        :param hears: topics that it records
        """
        began = time.monotonic()
        self._network = join(self._contender, self._seat, [*hears, *(player.plays.topic for player in self._players)])
        self._heard = [[] for _ in hears]
        for topic, heard in zip(hears, self._heard, strict=True):
            self._subscriptions.append(self._network.subscribe(topic, partial(self._take, heard)))
        for player in self._players:
            self._publishers.append(self._network.advertise(player.plays.topic))
        return began

    def matched(self) -> bool:
        """Whether its first topics have found those that hear them, and those that are heard."""
        found = all(publisher.matched() >= self._seat.robots - 1 for publisher in self._publishers[:1])
        heard = self._subscriptions if self._seat.shared else self._subscriptions[:1]
        return found and all(subscription.matched() > 0 for subscription in heard)

    def play(self, begin: float) -> list[float]:
        """Publish the messages at their recorded times. Return the time of the first one of each recording, s
        monotonic.

        :param begin: of all recordings, s monotonic
        """
        order = sorted(zip(self._players, self._publishers, strict=True), key=lambda pair: pair[0].plays.phase_s)
        for player, publisher in order:
            time.sleep(max(0.0, begin + player.plays.phase_s - time.monotonic()))
            player.play(publisher)
        end = begin + max(player.plays.phase_s + player.plays.duration_s for player in self._players) + _LATE_S
        while not all(player.over for player in self._players) and time.monotonic() < end:
            time.sleep(_POLL_S)
        for player in self._players:
            player.close()
        return [player.t_first for player in self._players]

    def count(self) -> int:
        """Number of messages that have arrived."""
        return sum(map(len, self._heard))

    def heard(self) -> list[list[tuple[float, bytes]]]:
        """All messages that have arrived, by topic, each with its time of arrival, s monotonic."""
        with self._lock:
            return [list(heard) for heard in self._heard]

    def _take(self, heard: list[tuple[float, bytes]], payload: bytes) -> None:
        now = time.monotonic()
        with self._lock:
            heard.append((now, payload))

    def close(self) -> None:
        for player in self._players:
            player.close()
        if self._network is not None:
            self._network.close()
