"""A slotted channel between endpoints of version 1, for tests: who sends what is heard by all others, or lost."""

from __future__ import annotations

import random
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from math import inf
from typing import Any

from gr_ros2.link import AirPacket
from gr_ros2.link.access import Access
from gr_ros2.link.events import Delivered, ReceiverEvent, SenderEvent
from gr_ros2.link.rate import Mcs
from gr_ros2.link.v1.endpoint import EndpointV1
from gr_ros2.link.v1.endpoint_settings import Settings
from gr_ros2.link.v1.sealing import Keys, SealMode
from gr_ros2.settings.config import SendOptions
from gr_ros2.settings.registry import Registry, Topic
from tests.link.v1.invariants import PacketsEnd
from tests.packets import data_of

KEY = bytes(range(32))
SLOT_S = 1 / 75


def registry(**options: SendOptions) -> Registry:
    """Topics by name with their options; odom, scan and map where none are named."""
    named = options or {"odom": SendOptions(), "scan": SendOptions(queue="latest"), "map": SendOptions(qos="bulk")}
    return Registry([Topic(n, name, "std_msgs/msg/String", option) for n, (name, option) in enumerate(named.items())])


def keys(mode: SealMode) -> Keys:
    return Keys((KEY,) if mode != "none" else (), mode)


class Robot:
    """An endpoint, what it told, and what it must not forget.

    :param coding: its codec, and what makes a decoder from the table of another robot
    :param access: what decides when it may send
    """

    relays = False
    """Whether all send on what others make (``conftest.relaying``)."""
    mcs_table: Sequence[Mcs] = ()

    def __init__(
        self,
        src_id: int,
        topics: Registry | None = None,
        *,
        mode: SealMode = "none",
        coding: tuple[Any, Any] = (None, None),
        access: Access | None = None,
        **settings: Any,
    ) -> None:
        self.src_id, self.topics, self.coding = src_id, topics, coding
        self.keys = keys(mode)
        self.settings = Settings(src_id, **{"packet_len": 64, "relay": self.relays, "access": access, **settings})
        self.stored: dict[int, tuple[int, int]] = {}
        self.save: Callable[[int, tuple[int, int]], None] = self.stored.__setitem__
        self.boot = 1000 * abs(src_id)
        self.events: list[SenderEvent | ReceiverEvent] = []
        self.start()

    @property
    def access(self) -> Access | None:
        """What decides when it may send; another one acts from the next start on."""
        return self.settings.access

    @access.setter
    def access(self, access: Access) -> None:
        self.settings = replace(self.settings, access=access)

    def start(self, boot: int | None = None) -> None:
        """Start anew: everything but the stored state is forgotten."""
        self.boot = self.boot + 1 if boot is None else boot
        self.end = EndpointV1(
            self.topics,
            self.settings,
            boot=self.boot,
            keys=self.keys,
            codec=self.coding[0],
            decoder_for=self.coding[1],
            heard=dict(self.stored),
            save=lambda src_id, boot, floor: self.save(src_id, (boot, floor)),
            observer=self.events.append,
            mcs_table=self.mcs_table,
        )
        self.end.pace.use_credit()

    def slot(self, now: float) -> bytes | None:
        """What it sends in a slot."""
        if self.end.pace.out_of_credit:
            self.end.pace.credit()
        return data_of(self.end.next_packet(now))

    def receive(self, data: bytes, now: float, began: float | None = None) -> list[ReceiverEvent]:
        """What a packet causes."""
        events = self.end.receive(AirPacket(data, began), now)
        self.events += events
        return events

    def delivered(self, src_id: int | None = None) -> list[bytes]:
        """Payloads delivered so far, by one robot or by all."""
        found = [event for event in self.events if isinstance(event, Delivered)]
        return [event.payload for event in found if src_id in (None, event.src_id)]


class Air:
    """Slots of a full-duplex channel; ``lost(sender, receiver)`` decides packet by packet.

    :param delay: slots from the departure of a packet to its arrival
    """

    def __init__(self, *robots: Robot, loss: float = 0.0, seed: int = 1, delay: int = 1) -> None:
        self.robots = list(robots)
        self.under_way: deque[list[tuple[Robot, bytes]]] = deque([[] for _ in range(delay - 1)])
        self.now = 0.0
        self.rng = random.Random(seed)
        self.lost: Callable[[Robot, Robot], bool] = lambda _, __: self.rng.random() < loss
        self.recorded: list[tuple[Robot, bytes]] = []
        self.invariant = PacketsEnd(self.robots)

    def step(self) -> None:
        """One slot."""
        left = [(robot, data) for robot in self.robots if (data := robot.slot(self.now)) is not None]
        self.recorded += left
        self.under_way.append(left)
        self.now += SLOT_S
        arriving = self.under_way.popleft()
        for robot, data in arriving:
            for other in self.robots:
                if other is not robot and not self.lost(robot, other):
                    other.receive(data, self.now)
        for robot in self.robots:
            robot.events += robot.end.handle_timeout(self.now)
        if left or arriving:
            self.invariant.step()

    def run(self, seconds: float, until: Callable[[], bool] = lambda: False) -> float:
        """So long, or until something is so; the time it took."""
        begin = rests = self.now
        while self.now - begin < seconds and not until():
            if self.now < rests:
                self.now += SLOT_S
            else:
                self.step()
                rests = self._rests()
        return self.now - begin

    def _rests(self) -> float:
        """Until when robots have nothing to do if nothing is said: the threads of a live link sleep so long, too."""
        if any(self.under_way) or any(robot.end.pace.out_of_credit for robot in self.robots):
            return self.now
        departures = [robot.end.next_departure() for robot in self.robots]
        timeouts = [robot.end.next_timeout() for robot in self.robots]
        soonest = min((at for at in departures if at is not None), default=inf)
        return min(soonest, *(at - SLOT_S for at in timeouts if at is not None), inf)
