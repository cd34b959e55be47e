"""The two programs at the ends of the radio link: one plays a recording, the other records what arrives.

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
from dataclasses import dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import Any

from gr_ros2.middleware import Publisher, Qos, Subscription, join_graph
from gr_ros2.middleware.bag import BagMiddleware
from gr_ros2.middleware.base import MessageCallback, Reliability
from gr_ros2.race.contenders import ADDRESSES, Contender, cyclone_uri, zenoh_config
from gr_ros2.race.links import DEPTH, DOMAINS
from gr_ros2.race.tun import INTERFACE

_ROS_DEPTH = 10
"""Messages that ROS 2 nodes keep by default."""
_DOMAIN = 0
_POLL_S = 0.02
_LATE_S = 1.0
"""s that the player of a recording may be late, because the computer is busy."""


@dataclass(frozen=True)
class RaceTopic:
    """The topic that is sent, and its name at the receiving end."""

    name: str
    type_name: str
    output: str


class Network(ABC):
    """The connection of one end to the network that carries the messages."""

    @abstractmethod
    def advertise(self, topic: str, type_name: str) -> Publisher:
        """Create a publisher."""

    @abstractmethod
    def subscribe(self, topic: str, type_name: str, callback: MessageCallback) -> Subscription:
        """Create a subscription."""

    @abstractmethod
    def close(self) -> None: ...


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
            )
        )

    def subscribe(self, topic: str, type_name: str, callback: MessageCallback) -> Subscription:  # noqa: ARG002
        return _PlainZenohSubscription(
            self._session.declare_subscriber(topic.lstrip("/"), lambda sample: callback(sample.payload.to_bytes())),
            self._session,
        )

    def close(self) -> None:
        self._session.close()


class _PlainZenohPublisher(Publisher):
    def __init__(self, publisher: Any) -> None:
        self._publisher = publisher

    def publish(self, payload: bytes) -> None:
        self._publisher.put(payload)

    def matched(self) -> int:
        return int(self._publisher.matching_status.matching)

    def close(self) -> None:
        self._publisher.undeclare()


class _PlainZenohSubscription(Subscription):
    def __init__(self, subscriber: Any, session: Any) -> None:
        super().__init__()
        self._subscriber, self._session = subscriber, session

    def matched(self) -> int:
        return len(self._session.info.peers_zid())

    def close(self) -> None:
        self._subscriber.undeclare()


def join(contender: Contender, receiving: bool) -> Network:
    """Connect one end of a contender.

    :raises MiddlewareError: when that fails
    """
    if contender.stack == "zenoh":
        config = zenoh_config(contender.settings["transport"], receiving)
        return ZenohNetwork(config, contender.reliable, contender.settings["congestion"])
    if contender.stack == "gr-ros2":  # the local graphs lose nothing; the radio is between them
        return DdsNetwork(DOMAINS[receiving], True, Qos("reliable", "volatile", DEPTH))
    os.environ["CYCLONEDDS_URI"] = cyclone_uri(ADDRESSES[not receiving], INTERFACE)
    reliability: Reliability = "reliable" if contender.reliable else "best_effort"
    return DdsNetwork(_DOMAIN, False, Qos(reliability, "volatile", _ROS_DEPTH))


class RacePublisher:
    """Plays one topic of a bag.

    :param messages: number of messages to publish
    :param duration_s: length of the recording, s; a message that the network delays by more than a second beyond this
        time is never published
    """

    def __init__(self, contender: Contender, topic: RaceTopic, bag: Path, messages: int, duration_s: float) -> None:
        self._contender, self._topic = contender, topic
        self._messages, self._duration_s = messages, duration_s
        self._bag = BagMiddleware(path=bag)
        self._network: Network | None = None
        self._published = 0
        self._t_first = float("nan")

    def connect(self) -> float:
        """Join the network. Return the time at which joining began, s monotonic."""
        began = time.monotonic()
        self._network = join(self._contender, receiving=False)
        self._publisher = self._network.advertise(self._topic.name, self._topic.type_name)
        return began

    def matched(self) -> bool:
        """Whether the publisher has found the receiving end."""
        return self._publisher.matched() > 0

    def play(self) -> float:
        """Publish the messages at their recorded times. Return the time of the first one, s monotonic."""
        self._bag.subscribe(self._topic.name, self._topic.type_name, Qos(), self._publish)
        self._bag.start()
        end = time.monotonic() + self._duration_s + _LATE_S
        while self._published < self._messages and time.monotonic() < end:
            time.sleep(_POLL_S)
        self._bag.close()
        return self._t_first

    def _publish(self, payload: bytes) -> None:
        if not self._published:
            self._t_first = time.monotonic()
        if self._published < self._messages:
            self._publisher.publish(payload)
            self._published += 1

    def __enter__(self) -> RacePublisher:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bag.close()
        if self._network is not None:
            self._network.close()


class RaceSubscriber:
    """Records the messages that arrive on one topic."""

    def __init__(self, contender: Contender, topic: RaceTopic) -> None:
        self._contender, self._topic = contender, topic
        self._network: Network | None = None
        self._heard: list[tuple[float, bytes]] = []
        self._lock = threading.Lock()

    def connect(self) -> float:
        """Join the network. Return the time at which joining began, s monotonic."""
        began = time.monotonic()
        self._network = join(self._contender, receiving=True)
        self._subscription = self._network.subscribe(self._topic.output, self._topic.type_name, self._take)
        return began

    def matched(self) -> bool:
        """Whether the subscription has found the sending end."""
        return self._subscription.matched() > 0

    def count(self) -> int:
        """Number of messages that have arrived."""
        return len(self._heard)

    def heard(self) -> list[tuple[float, bytes]]:
        """All messages that have arrived, each with its time of arrival, s monotonic."""
        with self._lock:
            return list(self._heard)

    def _take(self, payload: bytes) -> None:
        now = time.monotonic()
        with self._lock:
            self._heard.append((now, payload))

    def __enter__(self) -> RaceSubscriber:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._network is not None:
            self._network.close()
