"""Services across links of several robots, with whole blocks and graphs in memory, in simulated time."""

from __future__ import annotations

import random
import threading
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from gr_ros2.calls.throughput_frames import MEASURE, REPORT
from gr_ros2.gr import RosLink
from gr_ros2.link import AirPacket
from gr_ros2.link.air import Air
from gr_ros2.link.events import ReceiverEvent
from gr_ros2.mac import Slots
from gr_ros2.middleware.memory import MemoryMiddleware
from gr_ros2.settings.config import SendOptions
from gr_ros2.settings.robot import RobotConfig
from tests.domains import free_domains
from tests.link.v1.air import SLOT_S
from tests.link.v1.test_relaying import Line
from tests.middleware.calling import ADD, Adder, Caller
from tests.packets import data_of

LAST = 4
CALLS = 50
NEAR, FAR = f"/rx_robot_{LAST}/add", f"/robot_{LAST}/add"


class LinkedRobot:
    """A link whose packets a test carries, as a robot of a :class:`Line`.

    :param folder: for the state of its starts
    """

    def __init__(self, src_id: int, line: Line, folder: Any, stack: ExitStack) -> None:
        self.src_id, self.events = src_id, list[ReceiverEvent]()
        (domain,) = free_domains(1)
        self._graphs = [stack.enter_context(MemoryMiddleware(domain_id=domain)) for _ in range(2)]
        self.graph, own = self._graphs
        registry = Path(folder, "topics.csv")
        registry.write_text(f"odom,std_msgs/String\nadd,{ADD}\n")
        config = RobotConfig(
            robot=f"/robot_{src_id}",
            registry=str(registry),
            packet_len=96,
            topics={"auto": SendOptions(), "odom": SendOptions(queue="latest")},
            state=f"{folder}/{src_id}",
        )
        self.link = RosLink(
            config,
            air=Air(
                half_duplex=True,
                relay=True,
                access=lambda robot: Slots(robot, SLOT_S, random.Random(robot), period_s=0.1),
            ),
            middleware=own,
            clock=lambda: line.now,
        )
        stack.callback(self.link.close)
        self.link.source.use_credit()
        self._endpoint = self.link.end.endpoint
        self.messages = self._endpoint.messages

    @property
    def end(self) -> LinkedRobot:
        return self

    def next_departure(self, *, credited: bool) -> float | None:
        """When its next packet may leave."""
        return self._endpoint.next_departure(credited=credited)

    def slot(self, now: float) -> bytes | None:
        """What it sends in a slot."""
        if self._endpoint.pace.out_of_credit:
            self._endpoint.pace.credit()
        with self.link.end.lock:
            return data_of(self._endpoint.next_packet(now))

    def receive(self, data: bytes, now: float, began: float) -> None:
        """Take a packet."""
        with self.link.end.lock:
            events = self._endpoint.receive(AirPacket(data, began), now)
        self._settle(events)

    def handle_timeout(self, now: float) -> list[ReceiverEvent]:
        """Look what has become too late."""
        with self.link.end.lock:
            events = list(self._endpoint.handle_timeout(now))
        self._settle(events)
        return []

    def _settle(self, events: list[ReceiverEvent]) -> None:
        if events:
            self.link.sink._events += events
            self.link.sink._settle()
            self.settle()

    def settle(self) -> None:
        """Wait until programs, server and client on its graph have taken what they were sent."""
        for graph in 2 * self._graphs:
            taken = threading.Event()
            graph.thread.call(taken.set)
            taken.wait()

    def counted(self) -> dict[str, int]:
        return dict(self.link.calls.stats()["counters"])  # type: ignore[union-attr]


@pytest.fixture
def line(tmp_path: Any) -> Iterator[Line]:
    line = Line(loss=0.1)
    with ExitStack() as stack:
        line.robots = [LinkedRobot(src_id, line, tmp_path, stack) for src_id in range(1, LAST + 1)]  # type: ignore[misc]
        yield line


@pytest.mark.parametrize("payload", [bytes([MEASURE]), bytes([REPORT]) + bytes(6)])
def test_a_question_about_the_link_that_cannot_be_read_is_counted(line: Line, payload: bytes) -> None:
    first, second, *_ = line.robots
    while not first.link.calls.ask(2, payload, lambda _: None, 30):  # type: ignore[attr-defined]
        line.run(1)
    end = line.now + 30
    while line.now < end and "malformed" not in second.counted():  # type: ignore[attr-defined]
        line.run(1)
    assert second.counted()["malformed"] == 1  # type: ignore[attr-defined]


@pytest.mark.slow
def test_calls_cross_three_hops_and_are_answered_once(line: Line) -> None:
    first, last = line.robots[0], line.robots[-1]
    adder, caller = Adder(last.graph, FAR), Caller(first.graph, NEAR)
    while not caller.there:
        line.run(1)
    for number in range(CALLS):
        caller.call(number)
        first.settle()
        line.run(1)
    end = line.now + 35
    while line.now < end and len(caller.got) < CALLS:
        line.run(1)
    assert len(caller.got) >= CALLS - 1
    assert all(totals == [number + 1000] for number, totals in caller.got.items())
    assert len(adder.taken) == len(set(adder.taken)) >= len(caller.got)
