"""A link of the two engines for tests: messages go in, packets get lost on purpose, listeners hear all of it."""

from __future__ import annotations

import random
from collections.abc import Callable
from typing import Any, Protocol

from gr_ros2.link import AirPacket
from gr_ros2.link.events import ReceiverEvent, SenderEvent
from gr_ros2.observe.positions import humble_types
from gr_ros2.paper.receiver import Receiver
from gr_ros2.paper.sender import Sender
from gr_ros2.paper.settings import paper_from
from gr_ros2.settings.registry import Registry
from tests.packets import data_of

REGISTRY = Registry.from_rows({"at": "geometry_msgs/PointStamped", "raw": "my_msgs/Thing"})
SRC = 4
NAMES = {(SRC, 0): "/robot_4/at", (SRC, 1): "/robot_4/raw"}


class Hears(Protocol):
    def sender_event(self, src_id: int, event: SenderEvent) -> None: ...
    def receiver_event(self, event: ReceiverEvent, now: float) -> None: ...


def at(x: float, y: float) -> bytes:
    """A serialized position."""
    types = humble_types().types
    header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](0, 0), "map")
    message = types["geometry_msgs/msg/PointStamped"](header, types["geometry_msgs/msg/Point"](x, y, 0.0))
    return bytes(humble_types().serialize_cdr(message, "geometry_msgs/msg/PointStamped"))


class Feed:
    """Sender, air and receiver.

    :param lost: whether the packet with this number is lost
    """

    def __init__(self, *observers: Hears, lost: Callable[[int], bool] = lambda _number: False, **settings: Any) -> None:
        self.observers = observers
        self.packets = 0
        self._lost = lost
        self.sender = Sender(
            REGISTRY, *paper_from(robot=SRC, **settings), rng=random.Random(1), observer=self._sender_event
        )
        self.forget()

    def forget(self) -> None:
        """The receiver starts anew."""
        config = self.sender.robot
        self.receiver = Receiver(REGISTRY, *paper_from(robot=0, packet_len=config.packet_len))

    def submit(self, topic_id: int, payload: bytes, now: float) -> None:
        self.sender.submit(topic_id, payload, now)

    def fly(self, now: float, latency: float = 0.05, most: int = 1_000_000) -> None:
        """At most so many packets cross."""
        for _ in range(most):
            data = data_of(self.sender.next_packet(now))
            if data is None:
                return
            self.packets += 1
            if self._lost(self.packets):
                continue
            self.hear(data, now + latency)

    def hear(self, data: bytes, now: float) -> None:
        """Bytes come to the receiver."""
        self._tell(self.receiver.receive(AirPacket(data), now), now)

    def pass_time(self, now: float) -> None:
        """Time passes at the receiver."""
        self._tell(self.receiver.handle_timeout(now), now)

    def _tell(self, events: list[ReceiverEvent], now: float) -> None:
        for event in events:
            for observer in self.observers:
                observer.receiver_event(event, now)

    def _sender_event(self, event: SenderEvent) -> None:
        for observer in self.observers:
            observer.sender_event(SRC, event)
