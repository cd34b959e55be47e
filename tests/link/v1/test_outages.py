"""Reliable messages after an outage: robots out of each other's range, one way first, with restarts, with a key and
without."""

from __future__ import annotations

import pytest

from gr_ros2.link.v1.sealing import SealMode
from gr_ros2.settings.config import SendOptions
from tests.link.v1.air import Air, Robot, registry
from tests.pairs import pairs

MODES: tuple[SealMode, ...] = ("none", "encrypt")
EVERY_S = 0.05
TOPICS = registry(
    goal=SendOptions(reliability="reliable", queue="fifo"),
    odom=SendOptions(queue="latest"),
    path=SendOptions(reliability="reliable", queue="fifo", qos="bulk"),
    imu=SendOptions(queue="deadline", deadline_s=0.2),
)
SIZES = (40, 100, 500, 20)

pytestmark = pytest.mark.usefixtures("relaying")


class Talk:
    """Robots of which each says something on every topic in turn, and what was said.

    :ivar cut: pairs of sender and receiver that are out of range
    """

    def __init__(self, *robots: Robot, loss: float = 0.0, seed: int = 1) -> None:
        self.air = Air(*robots, seed=seed)
        self.robots, self.cut = robots, set[tuple[int, int]]()
        self.said: dict[int, list[bytes]] = {robot.src_id: [] for robot in robots}
        self._number, air = 0, self.air
        air.lost = lambda one, two: (one.src_id, two.src_id) in self.cut or air.rng.random() < loss

    def run(self, seconds: float, every_s: float = EVERY_S) -> None:
        end = self.air.now + seconds
        while self.air.now < end:
            for robot in self.robots:
                if robot.topics:
                    topic = self._number % 4
                    text = b"%d %d" % (topic, self._number)
                    robot.end.messages.submit(topic, text.ljust(SIZES[topic]), self.air.now)
                    self.said[robot.src_id].append(text)
            self._number += 1
            self.air.run(every_s)

    def part(self, *pairs: tuple[int, int]) -> None:
        self.cut = set(pairs)

    def got(self, receiver: Robot, sender: int, topic: int) -> list[bytes]:
        return [text.rstrip() for text in receiver.delivered(sender) if text.startswith(b"%d " % topic)]

    def reliable(self, sender: int) -> list[tuple[int, list[bytes]]]:
        return [(topic, [t for t in self.said[sender] if t.startswith(b"%d " % topic)]) for topic in (0, 2)]


def two(mode: SealMode, *, both: bool, **settings: object) -> tuple[Robot, Robot]:
    one = Robot(1, TOPICS, mode=mode, packet_len=220, any_length=True, **settings)
    return one, Robot(2, TOPICS if both else None, mode=mode, packet_len=220, any_length=True, **settings)


LATER: dict[str, tuple[set[tuple[int, int]], float]] = {
    "both at once": (set(), 0.0),
    "to the other 3 s later": ({(1, 2)}, 3.0),
    "back 3 s later": ({(2, 1)}, 3.0),
    "back 15 s later": ({(2, 1)}, 15.0),
}
"""Which way is back last after an outage, and by how many s."""


@pairs("relaying", relaying=[False, True], both=[False, True], seconds=[12.0, 30.0], later=list(LATER))
def test_every_reliable_message_arrives_after_an_outage(both: bool, seconds: float, later: str) -> None:
    one, other = two("encrypt" if both else "none", both=both)
    one_way, wait = LATER[later]
    talk = Talk(one, other, loss=0.1)
    talk.run(5)
    talk.part((1, 2), (2, 1))
    talk.run(seconds)
    talk.part(*one_way)
    talk.run(wait)
    talk.part()
    talk.run(3)
    talk.air.run(60)
    talk.run(1)
    talk.air.run(5)
    for sender, receiver in ((one, other), (other, one)) if both else ((one, other),):
        for topic, said in talk.reliable(sender.src_id):
            assert talk.got(receiver, sender.src_id, topic) == said


@pairs("relaying", relaying=[False, True], early=[False, True], restarts=[1, 2], mode=MODES)
def test_a_reliable_topic_goes_on_after_a_restart_in_an_outage(mode: SealMode, restarts: int, early: bool) -> None:
    one, other = two(mode, both=True)
    talk = Talk(one, other, loss=0.1)
    talk.run(5)
    for seconds in (3.0, 12.0):
        talk.part((1, 2), (2, 1))
        talk.run(seconds)
        (one if restarts == 1 else other).start()
        talk.run(1)
        talk.part(*{(2, 1)} if early else ())
        talk.run(5)
        talk.part()
        talk.run(3)
        talk.air.run(60)
    talk.run(1)
    talk.air.run(5)
    for sender, receiver in ((one, other), (other, one)):
        for topic, said in talk.reliable(sender.src_id):
            assert talk.got(receiver, sender.src_id, topic)[-5:] == said[-5:]


@pytest.mark.parametrize("mode", MODES)
def test_a_reliable_topic_goes_on_one_way_after_an_outage(mode: SealMode) -> None:
    one, other = two(mode, both=False, hears=False)
    talk = Talk(one, other, loss=0.1)
    for seconds in (3.0, 12.0):
        talk.run(5)
        talk.part((1, 2))
        talk.run(seconds)
        talk.part()
    talk.run(5)
    talk.air.run(20)
    for topic, said in talk.reliable(1):
        assert talk.got(other, 1, topic)[-5:] == said[-5:]


@pytest.mark.parametrize(("relaying", "mode"), [(False, "none"), (True, "encrypt")], indirect=["relaying"])
def test_a_robot_that_is_out_of_range_keeps_nothing_back_from_a_third(mode: SealMode) -> None:
    one, other = two(mode, both=False)
    third = Robot(3, None, mode=mode, packet_len=220, any_length=True)
    talk = Talk(one, other, third, loss=0.1)
    talk.run(5)
    talk.part((1, 2), (2, 1))
    talk.run(12)
    third.start()
    talk.run(5)
    talk.part((2, 1))
    talk.run(3)
    talk.part()
    talk.run(5)
    talk.air.run(30)
    for topic, said in talk.reliable(1):
        assert talk.got(other, 1, topic) == said
        assert talk.got(third, 1, topic)[-50:] == said[-50:]


def apart(talk: Talk, seconds: float) -> None:
    """Out of range for so long, in which nothing is said."""
    talk.part((1, 2), (2, 1))
    talk.air.run(seconds)


@pytest.mark.parametrize("mode", MODES)
def test_a_long_message_goes_on_where_an_outage_has_interrupted_it(mode: SealMode) -> None:
    one, other = two(mode, both=False)
    talk = Talk(one, other)
    talk.run(2)
    one.end.messages.submit(2, long := bytes(20_000), talk.air.now)
    talk.air.run(0.5)
    apart(talk, 100)
    talk.part()
    talk.air.run(20)
    assert long in other.delivered()


def test_what_is_not_reliable_is_not_delivered_after_an_outage_also_beside_what_is() -> None:
    one, other = two("none", both=False)
    talk = Talk(one, other)
    talk.run(2)
    talk.part((1, 2), (2, 1))
    one.end.messages.submit(0, b"goal", talk.air.now)
    one.end.messages.submit(3, b"command", talk.air.now)
    talk.air.run(20)
    talk.part()
    talk.air.run(20)
    assert b"goal" in other.delivered() and b"command" not in other.delivered()
    assert other.end.received.lost[1, 3, "late"] == 1


def test_memory_is_the_bound_of_what_is_kept_for_a_robot_out_of_range(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gr_ros2.link.v1.lifetime.MOST_LIFETIMES", 100)
    one, other = two("encrypt", both=False)
    talk = Talk(one, other)
    talk.run(5)
    talk.part((1, 2), (2, 1))
    talk.run(60)
    talk.part()
    talk.run(5)
    talk.air.run(30)
    for topic, said in talk.reliable(1):
        got = talk.got(other, 1, topic)
        assert 150 < len(said) - len(got) < 240
        assert got[-90:] == said[-90:]


def test_a_sender_is_silent_while_the_robot_that_lacks_something_is_out_of_range() -> None:
    one, other = two("none", both=False)
    talk = Talk(one, other)
    talk.run(2)
    talk.part((1, 2), (2, 1))
    talk.run(20)
    talk.air.run(30)
    before = len(talk.air.recorded)
    talk.air.run(60)
    assert sum(robot is one for robot, _ in talk.air.recorded[before:]) < 20
    assert one.end.idle and one.end.window.packets.unconfirmed(talk.air.now)


def test_what_waits_for_a_lost_packet_comes_out_when_its_sender_starts_again() -> None:
    one, other = two("none", both=False)
    talk = Talk(one, other)
    talk.air.run(2)
    talk.part((1, 2))
    one.end.messages.submit(0, b"lost", talk.air.now)
    talk.air.step()
    talk.part()
    one.end.messages.submit(0, b"here", talk.air.now)
    talk.air.step()
    apart(talk, 20)
    assert other.delivered() == []
    one.start()
    talk.part()
    one.end.messages.submit(0, b"new", talk.air.now)
    talk.air.run(5)
    assert other.delivered() == [b"here", b"new"]


@pytest.mark.parametrize(("relaying", "loss"), [(False, 0.0), (True, 0.2)], indirect=["relaying"])
def test_new_messages_cross_while_those_of_a_long_outage_are_repaired(loss: float) -> None:
    one, other = two("none", both=False)
    talk = Talk(one, other, loss=loss)
    talk.run(5)
    talk.part((1, 2), (2, 1))
    talk.run(120)
    talk.part()
    before = len(talk.got(other, 1, 1))
    talk.run(5)
    assert one.end.window.packets.unconfirmed(talk.air.now), "all is repaired: nothing is tested"
    assert len(talk.got(other, 1, 1)) - before >= 15
    talk.air.run(60)
    for topic, said in talk.reliable(1):
        assert talk.got(other, 1, topic) == said


def test_a_full_link_says_after_an_outage_what_it_does_not_repair() -> None:
    """Reports name the newest packets and the oldest missing ones in turn: the former do not end the wait for these."""
    one, other = Robot(1, registry(goal=SendOptions(), odom=SendOptions(queue="latest"))), Robot(2)
    air, goals = Air(one, other), []
    air.lost = lambda *_: 3 <= air.now < 9
    for slot in range(1275):
        one.end.messages.submit(1, bytes(62), air.now)  # more than a packet in every slot
        if slot % 20 == 0:
            goals.append(b"%d" % slot)
            one.end.messages.submit(0, goals[-1], air.now)
        air.step()
    assert [text for text in other.delivered() if len(text) < 62] == goals


@pytest.mark.parametrize(("relaying", "mode"), [(False, "encrypt"), (True, "none")], indirect=["relaying"])
def test_a_robot_that_hears_nothing_takes_no_air_with_repairs(mode: SealMode) -> None:
    """It is heard itself, so anybody without a key could otherwise have all that is free, by a hello now and then."""
    one, other = Robot(1, TOPICS, mode=mode, packet_len=220), Robot(2, mode=mode, packet_len=220)
    talk = Talk(one, other)
    talk.run(5, 0.5)
    talk.part((1, 2))
    before = len(talk.air.recorded)
    talk.run(60, 0.5)
    sent = sum(robot is one for robot, _ in talk.air.recorded[before:])
    assert sent < 6 * len(talk.said[1]), "before, more than 20 packets for each message"
    talk.part()
    talk.run(3, 0.5)
    talk.air.run(20)
    for topic, said in talk.reliable(1):
        assert talk.got(other, 1, topic) == said
