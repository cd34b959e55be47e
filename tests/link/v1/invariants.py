"""Every packet number below the newest is confirmed, can still be repaired, or is over: a check after every step.

For each pair of robots that hear each other:

- *Named.* Whatever of a message in order a peer has reported as lost is urgent, or its next report makes it so.
- *Within reach.* Whatever a receiver waits for and its sender repairs can be brought back: it is not that far below the
  last number that the receiver takes for a replay.
- *Within a bound.* While messages wait at a receiver, the packet that they wait for comes, or is said to be over,
  within so many packets that each of the two has heard of the other. The oldest packet in order that the sender repairs
  for robots that report is confirmed, or over, within the same bound.

Times do not count, so this holds for every packet rate, loss and medium access, and nothing is to be checked while
nothing leaves or arrives.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from gr_ros2.link.events import Received
from gr_ros2.link.v1.endpoint import EndpointV1
from gr_ros2.link.v1.neighbours import Neighbour
from gr_ros2.link.v1.peers import REACH

if TYPE_CHECKING:
    from tests.link.v1.air import Robot

BOUND = 1000
"""Packets heard each way."""


@dataclass
class _Waiting:
    """The packet that is waited for, and how many packets each way were heard when that began."""

    number: int = -1
    begun: tuple[int, int] = (0, 0)


@dataclass
class PacketsEnd:
    """The check of some robots. ``step`` is called after each of their steps.

    :param bound: packets heard each way within which a packet that is waited for comes, or is over
    """

    robots: Sequence[Robot]
    bound: int = BOUND
    _seen: Counter[int] = field(default_factory=Counter)
    _heard: Counter[tuple[int, int]] = field(default_factory=Counter)
    _waiting: dict[tuple[str, int, int, int, int], _Waiting] = field(default_factory=lambda: defaultdict(_Waiting))

    def step(self) -> None:
        for robot in self.robots:
            for event in robot.events[self._seen[robot.src_id] :]:
                if isinstance(event, Received):
                    self._heard[event.src_id, robot.src_id] += 1
            self._seen[robot.src_id] = len(robot.events)
        for sender in self.robots:
            for receiver in self.robots:
                known = receiver.end.neighbours.all.get(sender.src_id)
                if sender is not receiver and known is not None and known.boot == sender.boot:
                    self._check(sender, receiver, known)

    def _check(self, sender: Robot, receiver: Robot, known: Neighbour) -> None:
        packets, order, decoder = sender.end.window.packets, known.inbox.order, known.inbox.decoder
        peer = sender.end.window.peers.all.get(receiver.src_id)
        if peer is None or sender.end.window.mode == "off":
            return
        lost = peer.lost - {number for _, number in peer.urgent} if peer.lost and peer.newest >= 0 else ()
        for number in lost:
            assert not waited_for(sender.end, number), (
                f"packet {number} of robot {sender.src_id} counts as lost at robot {receiver.src_id} and is not urgent"
            )
        proven = known.proofs.proven
        if proven is not None and order.wanted < proven - REACH:
            for number in range(order.wanted, proven - REACH):
                record = packets.records.get(number)
                assert record is None or number in decoder.bodies or not record.alive(sender.end._now), (
                    f"robot {receiver.src_id} waits for packet {number} of robot {sender.src_id}, "
                    f"which no repair above {proven} brings back"
                )
        pair = sender.src_id, receiver.src_id, sender.boot, receiver.boot
        self._moves(("delivered", *pair), order.wanted if order.told and order.held else -1)
        self._moves(("confirmed", *pair), oldest_in_order(sender.end, peer.bit))

    def _moves(self, name: tuple[str, int, int, int, int], number: int) -> None:
        waiting = self._waiting[name]
        if number < 0:
            waiting.number = -1
            return
        _, one, other, _, _ = name
        there, back = self._heard[one, other], self._heard[other, one]
        if number != waiting.number:
            waiting.number, waiting.begun = number, (there, back)
        passed = min(there - waiting.begun[0], back - waiting.begun[1])
        assert passed < self.bound, (
            f"packet {number} of robot {one} is not {name[0]} after {passed} packets each way between it and {other}"
        )


def waited_for(end: EndpointV1, number: int) -> bool:
    """Whether a packet has a part of a message in order and is still repaired."""
    record = end.window.packets.records.get(number)
    return record is not None and any(one.in_order and end._now < one.expires for one in record.lifetimes)


def oldest_in_order(end: EndpointV1, bit: int) -> int:
    """The oldest packet of a message in order that a sender repairs for a robot; -1 for none."""
    now = end._now
    for number, record in end.window.packets.records.items():
        if not record.confirmed & bit:
            for one in record.lifetimes:  # ``waited_for``, whose call would take most of this loop's time
                if one.in_order and now < one.expires:
                    return number
    return -1
