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
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from gr_ros2.core.closing import Closing
from gr_ros2.middleware import Publisher, Qos, Subscription, join_graph
from gr_ros2.middleware.bag import BagMiddleware
from gr_ros2.middleware.base import MessageCallback, Reliability
from gr_ros2_lab.race.contenders import ADDRESSES, Contender, cyclone_uri, zenoh_config
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


class Network(ABC):
    """The connection of one end to the network that carries the messages."""

    @abstractmethod
    def advertise(self, topic: str, type_name: str) -> Publisher:
        """Create a publisher."""

    @abstractmethod
    def subscribe(self, topic: str, type_name: str, callback: MessageCallback) -> Subscription:
        """Create a subscription."""

    @abstractmethod
    def close(self) -> None:
        """Leave the network with all publishers and subscriptions."""


class DdsNetwork(Network):
    """A ROS 2 node on Cyclone DDS.

    :param qos: QoS of the publisher; a subscription has a larger depth, so that it loses no message on a busy computer
    """

    def __init__(self, domain_id: int, localhost_only: bool, qos: Qos) -> None:
        self._graph = join_graph("dds", domain_id=domain_id, node_name="race", localhost_only=localhost_only)
        self._qos = qos

    def advertise(self, topic: str, type_name: str) -> Publisher:
        return self._graph.advertise(topic, type_name, self._qos)

    def subscribe(self, topic: str, type_name: str, callback: MessageCallback) -> Subscription:
        return self._graph.subscribe(topic, type_name, replace(self._qos, depth=DEPTH), callback)

    def close(self) -> None:
        self._graph.close()


class ZenohNetwork(Network):
    """A Zenoh session.

    :param config: settings as in Zenoh's configuration file
    :param congestion: what a publisher does when its queue is full: a name in Zenoh's ``CongestionControl``
    """

    def __init__(self, config: dict[str, Any], reliable: bool, congestion: str) -> None:
        import zenoh  # imported here, because the other contenders do not need it

        self._reliability = zenoh.Reliability.RELIABLE if reliable else zenoh.Reliability.BEST_EFFORT
        self._congestion = getattr(zenoh.CongestionControl, congestion)
        self._session: Any = zenoh.open(zenoh.Config.from_json5(json.dumps(config)))

    def advertise(self, topic: str, type_name: str) -> Publisher:  # noqa: ARG002 - Zenoh has no types
        return _PlainZenohPublisher(
            self._session.declare_publisher(
                topic.lstrip("/"),
                congestion_control=self._congestion,
                reliability=self._reliability,
            ),
            self._session,
        )

    def subscribe(self, topic: str, type_name: str, callback: MessageCallback) -> Subscription:  # noqa: ARG002
        return _PlainZenohSubscription(
            self._session.declare_subscriber(topic.lstrip("/"), lambda sample: callback(sample.payload.to_bytes())),
            self._session,
        )

    def close(self) -> None:
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


def join(contender: Contender, seat: Seat) -> Network:
    """Connect a program to the network of a contender.

    :raises MiddlewareError: when that fails
    """
    if contender.stack == "zenoh":
        config = zenoh_config(contender.settings["transport"], seat.number, seat.robots, INTERFACE)
        return ZenohNetwork(config, contender.reliable, contender.settings["congestion"])
    if contender.stack == "gr-ros2":  # the local graphs lose nothing; the radio is between them
        return DdsNetwork(DOMAINS[seat.number], True, Qos("reliable", "volatile", DEPTH))
    os.environ["CYCLONEDDS_URI"] = cyclone_uri(INTERFACE, "" if seat.shared else ADDRESSES[1 - seat.number])
    reliability: Reliability = "reliable" if contender.reliable else "best_effort"
    return DdsNetwork(_DOMAIN, False, Qos(reliability, "volatile", _ROS_DEPTH))


class RaceProgram(Closing):
    """A program of a robot.

    :param plays: None: it only listens
    :param hears: topics that it records
    """

    def __init__(
        self, contender: Contender, seat: Seat, plays: Playback | None = None, hears: Sequence[RaceTopic] = ()
    ) -> None:
        self._contender, self._seat = contender, seat
        self._plays, self._hears = plays, hears
        self._bag = None if plays is None else BagMiddleware(path=plays.bag)
        self._network: Network | None = None
        self._publisher: Publisher | None = None
        self._subscriptions: list[Subscription] = []
        self._heard: list[list[tuple[float, bytes]]] = [[] for _ in hears]
        self._lock = threading.Lock()
        self._published = 0
        self._t_first = float("nan")

    def connect(self) -> float:
        """Join the network. Return the time at which joining began, s monotonic."""
        began = time.monotonic()
        self._network = join(self._contender, self._seat)
        for topic, heard in zip(self._hears, self._heard, strict=True):
            taken = partial(self._take, heard)
            self._subscriptions.append(self._network.subscribe(topic.name, topic.type_name, taken))
        if self._plays is not None:
            self._publisher = self._network.advertise(self._plays.topic.name, self._plays.topic.type_name)
        return began

    def matched(self) -> bool:
        """Whether the program has found those that it hears, and those that hear it."""
        found = self._publisher is None or self._publisher.matched() >= self._seat.robots - 1
        return found and all(subscription.matched() > 0 for subscription in self._subscriptions)

    def play(self, begin: float | None = None) -> float:
        """Publish the messages at their recorded times. Return the time of the first one, s monotonic.

        :param begin: of all recordings, s monotonic; None: now
        """
        assert self._bag is not None
        assert self._plays is not None
        if begin is not None:
            time.sleep(max(0.0, begin + self._plays.phase_s - time.monotonic()))
        self._bag.subscribe(self._plays.recorded, self._plays.topic.type_name, Qos(), self._publish)
        self._bag.start()
        end = time.monotonic() + self._plays.duration_s + _LATE_S
        while self._published < self._plays.messages and time.monotonic() < end:
            time.sleep(_POLL_S)
        self._bag.close()
        return self._t_first

    def _publish(self, payload: bytes) -> None:
        assert self._publisher is not None
        assert self._plays is not None
        if not self._published:
            self._t_first = time.monotonic()
        if self._published < self._plays.messages:
            self._publisher.publish(payload)
            self._published += 1

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
        if self._bag is not None:
            self._bag.close()
        if self._network is not None:
            self._network.close()
