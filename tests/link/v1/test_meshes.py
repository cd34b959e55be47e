"""Random meshes of keyed robots with relays: losses, outages, restarts, recordings and packets that are held back.

Nothing comes out twice, after a later message of its topic, after a later start of its maker, or at a robot for which
it is not; what is to come in time does; and no message for one robot is told to have come that has not.
"""

from __future__ import annotations

import random

import pytest

from gr_ros2.link.events import Delivered, Ended
from gr_ros2.mac import Slots
from gr_ros2.settings.config import SendOptions
from gr_ros2.settings.registry import Registry, Topic
from tests.link.v1.air import SLOT_S, Robot
from tests.link.v1.test_commands import TWIST
from tests.link.v1.test_relaying import Line, robot

STRING = "std_msgs/msg/String"
ODOM, GOAL, ALL, COMMAND = range(4)
HELD_S = 15.0
"""s by which packets that are held back make what is in them seem younger, at one hop."""
LATE_S = 2 * 0.5 + 0.3
"""Age in s of a command that comes in time: a deadline at its origin, one from there, and a few slots."""


def topics(to: int) -> Registry:
    options = SendOptions(queue="latest"), SendOptions(to=to), SendOptions(), SendOptions()
    names = ("odom", STRING), ("goal", STRING), ("all", STRING), ("cmd_vel", TWIST)
    return Registry([Topic(n, *name, option) for n, (name, option) in enumerate(zip(names, options, strict=True))])


class Mesh(Line):
    """Three to five robots, of which some hear each other, and what they say."""

    def __init__(self, seed: int) -> None:
        self.rng = rng = random.Random(seed)
        count = rng.randint(3, 5)
        ids = range(1, count + 1)
        self.to = {src_id: rng.choice([one for one in ids if one != src_id]) for src_id in ids}
        made = [robot(src_id, "encrypt", topics(to), packet_len=220) for src_id, to in self.to.items()]
        super().__init__(*made, loss=rng.choice([0.0, 0.1, 0.2]))
        pairs = {(rng.randrange(n), n) for n in range(1, count)}
        pairs |= {(one, other) for other in range(count) for one in range(other) if rng.random() < 0.3}
        self._near = pairs | {(other, one) for one, other in pairs}
        self._out: tuple[float, set[int]] = 0.0, set()
        self.made: dict[bytes, tuple[int, int, int, int, float]] = {}
        """By payload: robot, start, topic, which of them it is, and when, s."""
        self.told: list[bytes] = []
        self.came: list[tuple[float, int, int, Delivered]] = []
        """When, s, at which robot, in which start of it."""
        self._serials: dict[tuple[int, int, int], bytes] = {}
        self._looked = [0] * count
        self.air: list[tuple[int, bytes]] = []

    def near(self, one: int) -> list[int]:
        until, out = self._out
        away = out if self.now < until else set()
        return [other for other in range(len(self.robots)) if (other, one) in self._near and not {one, other} & away]

    def happen(self) -> None:
        """Some messages, a restart or an outage now and then, and packets that were recorded or held back."""
        rng = self.rng
        for n, one in enumerate(self.robots):
            topic = rng.choice((ODOM, GOAL, ALL, COMMAND))
            text = b"%d.%d.%d.%d" % (one.src_id, one.boot, topic, len(self.made))
            self._serials[one.src_id, one.boot, one.end.messages.ledger.serial] = text
            self.made[text] = one.src_id, one.boot, topic, len(self.made), self.now
            one.end.messages.submit(topic, text, self.now)
            if rng.random() < 0.01:
                self.restart(one)
            if self.air and rng.random() < 0.2:
                sender, data = rng.choice(self.air)
                if sender != n:
                    one.receive(data, self.now, self.now)
        if self.now > self._out[0] and rng.random() < 0.05:
            self._out = self.now + rng.choice([3, 12, 20]), {rng.randrange(len(self.robots))}

    def restart(self, one: Robot) -> None:
        one.access = Slots(one.src_id, SLOT_S, random.Random(self.rng.random()), period_s=0.0)
        one.start()
        self.invariant.__init__(self.robots)  # type: ignore[misc]
        self.invariant._seen.update({other.src_id: len(other.events) for other in self.robots})

    def look(self) -> None:
        """Note what has come out."""
        for n, one in enumerate(self.robots):
            for event in one.events[self._looked[n] :]:
                if isinstance(event, Delivered):
                    self.came.append((self.now, one.src_id, one.boot, event))
                elif isinstance(event, Ended) and event.arrived:
                    self.told.append(self._serials[one.src_id, one.boot, event.serial])
            self._looked[n] = len(one.events)

    def live(self, seconds: float) -> None:
        """So long; every robot says something several times per second."""
        for n, one in enumerate(self.robots):
            slot = type(one).slot

            def recorded(now: float, n: int = n, one: Robot = one, slot: object = slot) -> bytes | None:
                data = slot(one, now)  # type: ignore[operator]
                if data is not None:
                    self.air.append((n, data))
                return data

            one.slot = recorded  # type: ignore[method-assign]
        end = self.now + seconds
        while self.now < end:
            self.happen()
            self.run(0.3)
            self.look()

    def run(self, seconds: float) -> None:
        self._messages = 1 << 30  # it says nothing of its own
        super().run(seconds)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_what_comes_out_of_a_random_mesh_is_once_in_order_and_in_time(seed: int) -> None:
    mesh = Mesh(seed)
    mesh.live(60)
    assert len(mesh.came) > 200
    newest: dict[tuple[int, int, int, int, int], int] = {}
    starts: dict[tuple[int, int, int], int] = {}
    for now, here, start, event in mesh.came:
        src_id, boot, topic, number, at = mesh.made[event.payload]
        what = f"{event.payload!r} at robot {here}, {now:.2f} s, over {event.over}"
        assert (src_id, topic) == (event.src_id, event.topic_id), what
        assert topic != GOAL or mesh.to[src_id] == here, what
        assert boot >= starts.get((here, start, src_id), 0), f"{what}: an earlier start"
        assert number > newest.get((here, start, src_id, boot, topic), -1), f"{what}: twice, or after a later one"
        assert topic != COMMAND or now - at < LATE_S + HELD_S, f"{what}: {now - at:.2f} s old"
        starts[here, start, src_id], newest[here, start, src_id, boot, topic] = boot, number
    came = {event.payload for *_, event in mesh.came}
    assert not [text for text in mesh.told if text not in came], "told to have come"
