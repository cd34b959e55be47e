"""What arrives from one start of one robot: packets that become known at the same time."""

from __future__ import annotations

from typing import Any

import pytest

from gr_ros2.link.events import Delivered
from gr_ros2.link.v1.endpoint_settings import Settings
from gr_ros2.link.v1.gf256 import combine
from gr_ros2.link.v1.inbox import Inbox
from gr_ros2.link.v1.order import Ready
from gr_ros2.link.v1.outcomes import Outcomes
from gr_ros2.wire import v1
from gr_ros2.wire.table import AnnouncedTopic, write_table

ROOM = 60
ALL, GOAL = range(2)


class _Hands:
    """A message that is handed on by the robot that made it comes out at once."""

    inbox: Inbox

    def direct(self, *_: Any) -> None:
        pass

    def in_order(self, *_: Any) -> None:
        pass

    def receive(self, _via: int, ready: Ready, now: float, *, withheld: bool) -> None:
        assert not withheld
        self.inbox.relayed(Ready(GOAL, ready.order, ready.payload, -1, False, False, 0, 1, True, made=now), now)


def inbox_of(outcomes: Outcomes, relaying: Any = None, **settings: Any) -> Inbox:
    inbox = Inbox(
        1,
        1,
        1,
        ROOM,
        Settings(2, packet_len=80, **settings),
        decoder_for=None,
        marks={},
        outcomes=outcomes,
        control=lambda _: None,
        relaying=relaying,
    )
    rows = AnnouncedTopic(ALL, "all", "std_msgs/msg/String", reliable=True), AnnouncedTopic(GOAL, "goal", "x/msg/Y")
    inbox.announced.take(write_table(rows), (0, 0))
    return inbox


@pytest.mark.parametrize(("turn_s", "waits_s"), [(0.01, 60.0), (1.0, 180.0)])
def test_a_fragment_is_waited_for_longer_where_packets_take_long(turn_s: float, waits_s: float) -> None:
    outcomes = Outcomes()
    inbox = inbox_of(outcomes, packet_s=lambda: turn_s)
    part = v1.Part(GOAL, b"the first half", last=False)
    inbox.source(1, v1.write_body([part], ROOM).ljust(ROOM, b"\0"), [part], 0, 1.0)
    inbox.handle_timeout(waits_s)
    assert inbox.held
    assert inbox.next_timeout() == pytest.approx(1.0 + waits_s)
    inbox.handle_timeout(1.0 + waits_s)
    assert not inbox.held


def test_what_is_known_at_once_is_taken_before_what_waited_for_it() -> None:
    """The first of the packets that are taken hands on a message of its own robot."""
    outcomes, hands = Outcomes(), _Hands()
    inbox = hands.inbox = inbox_of(outcomes, hands)
    inbox.order.reported()
    parts = {1: v1.Part(v1.CARRIED_TOPIC, b"goal"), 2: v1.Part(ALL, b"the first"), 3: v1.Part(ALL, b"the second")}
    bodies = {number: v1.write_body([part], ROOM) for number, part in parts.items()}
    combined = combine([(number, bodies[number]) for number in (2, 1)], 5)
    inbox.source(3, bodies[3].ljust(ROOM, b"\0"), [parts[3]], 0, 1.0)
    inbox.repair(2, 0b11, 5, combined, oldest=True, now=1.0)
    inbox.source(1, bodies[1].ljust(ROOM, b"\0"), [parts[1]], 0, 1.0)
    got = [event.payload for event in outcomes.take() if isinstance(event, Delivered)]
    assert got == [b"goal", b"the first", b"the second"]
