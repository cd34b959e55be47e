"""An hour of three keyed robots in a row, in slots of .15 s: losses, outages of up to 200 s, restarts."""

from __future__ import annotations

import random

import pytest

from gr_ros2.link.events import Delivered
from gr_ros2.mac import Slots
from gr_ros2.settings.config import SendOptions
from tests.link.v1 import test_relaying
from tests.link.v1.air import Robot, registry
from tests.link.v1.test_relaying import Line, robot

SLOT_S, EVERY_S = 0.15, 2.0
TOPICS = registry(odom=SendOptions(queue="latest"), all=SendOptions())
ODOM, ALL = range(2)


class Hours(Line):
    """Every robot says something on both topics every 2 s. One after the other is out of reach of all.

    :ivar out: the robot that is out of reach, -1 for none
    """

    def __init__(self, *robots: Robot, loss: float) -> None:
        super().__init__(*robots, loss=loss)
        self.out = -1
        self._messages = 1 << 30  # it says nothing of its own
        self.made: dict[bytes, float] = {}

    def near(self, one: int) -> list[int]:
        return [other for other in super().near(one) if self.out not in (one, other)]

    def talk(self, seconds: float) -> None:
        end = self.now + seconds
        while self.now < end:
            for one in self.robots:
                for topic in (ODOM, ALL):
                    text = b"%d %d %.1f" % (one.src_id, topic, self.now)
                    self.made[text] = self.now
                    one.end.messages.submit(topic, text, self.now)
            self.run(EVERY_S)

    def restart(self, one: Robot) -> None:
        one.access = Slots(one.src_id, SLOT_S, random.Random(self.now), period_s=0.0)
        one.start()


@pytest.mark.slow
def test_nothing_stops_in_hours_with_outages_and_restarts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(test_relaying, "SLOT_S", SLOT_S)
    hours, rng = Hours(*(robot(n, "encrypt", TOPICS, packet_len=220) for n in (1, 2, 3)), loss=0.1), random.Random(1)
    hours.invariant.bound = 400
    for part in range(8):
        hours.out = rng.randrange(3)
        hours.talk(rng.choice([12, 60, 200]))
        if part % 4 == 3:
            hours.restart(hours.robots[rng.randrange(3)])
        hours.out = -1
        hours.talk(120)
    hours.talk(240)
    for here, one in enumerate(hours.robots):
        for near in hours.near(here):
            src_id = hours.robots[near].src_id
            came = [e.payload for e in one.events if isinstance(e, Delivered) and e.src_id == src_id]
            late = [text for text in came if hours.made[text] > hours.now - 60]
            assert {text.split()[1] for text in late} == {b"0", b"1"}, f"from robot {src_id} to {one.src_id}"
