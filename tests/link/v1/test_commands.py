"""Commands come in time or not at all, without any setting."""

from __future__ import annotations

import random
from typing import Any

import pytest

from gr_ros2.core.errors import ConfigError
from gr_ros2.link.events import Delivered, Lost, ReceiverEvent
from gr_ros2.link.queues import PublisherQos
from gr_ros2.link.v1.sealing import SealMode
from gr_ros2.settings.commands import COMMAND_DEADLINE_S, is_command
from gr_ros2.settings.config import SendOptions, build
from gr_ros2.settings.registry import Registry, Topic
from gr_ros2.settings.robot import RobotConfig
from tests.link.v1.air import SLOT_S, Air, Robot

TWIST = "geometry_msgs/msg/Twist"


def robot(**options: SendOptions) -> Robot:
    """It sends commands and large strings."""
    names = {"cmd_vel": TWIST, "text": "std_msgs/msg/String"}
    return Robot(
        1, Registry([Topic(n, name, names[name], options.get(name, SendOptions())) for n, name in enumerate(names)])
    )


def ages(sender: Robot, *, seconds: float = 4.0, loss: float = 0.0) -> list[float]:
    """How old commands are that are delivered on a link which is full of other messages and stands still for a second
    again and again."""
    air = Air(sender, Robot(2), loss=loss)
    given: dict[bytes, float] = {}
    seen: list[float] = []

    def heard(data: bytes, now: float) -> list[ReceiverEvent]:
        events = receive(data, now)
        seen.extend(now - given[e.payload] for e in events if isinstance(e, Delivered) and e.topic_id == 0)
        return events

    receive, air.robots[1].receive = air.robots[1].receive, heard  # type: ignore[method-assign]
    air.run(1.0)
    slot = sender.slot
    begin = air.now
    while air.now < begin + seconds:
        payload = b"%f" % air.now
        given[payload] = air.now
        sender.end.messages.submit(0, payload, air.now)
        sender.end.messages.submit(1, bytes(2000), air.now)
        stands = air.now % 2 > 1
        sender.slot = (lambda _: None) if stands else slot  # type: ignore[method-assign]
        air.run(0.1)
    sender.slot = slot  # type: ignore[method-assign]
    return seen


@pytest.mark.parametrize("loss", [0.0, 0.2])
def test_no_command_comes_late_and_those_that_would_are_counted(loss: float) -> None:
    sender = robot()
    found = ages(sender, loss=loss)
    assert len(found) > 10
    # A receiver knows of a lost packet, and counts from then on, when the next one arrives.
    assert max(found) <= COMMAND_DEADLINE_S + (5 if loss else 1) * SLOT_S
    refused = sender.end.sent.refused
    assert refused[0, "stale"] + refused[0, "cannot_complete"] > 5


def test_the_options_of_a_topic_say_otherwise() -> None:
    assert max(ages(robot(cmd_vel=SendOptions(deadline_s=0.0)))) > 0.8
    assert robot(cmd_vel=SendOptions(deadline_s=1.0)).end.messages.queue(0) == ("deadline", 1.0)
    assert robot(cmd_vel=SendOptions(queue="latest")).end.messages.queue(0) == ("latest", COMMAND_DEADLINE_S)


def test_what_a_user_names_is_a_command_and_with_no_name_nothing_is() -> None:
    assert robot().end.messages.queue(1) == ("fifo", 0.0)
    named = Robot(1, Registry([Topic(0, "arm/goal", "std_msgs/msg/String")]), commands=("arm/*",))
    assert named.end.messages.queue(0) == ("deadline", COMMAND_DEADLINE_S)
    none = Robot(1, Registry([Topic(0, "cmd_vel", TWIST)]), commands=())
    assert none.end.messages.queue(0) == ("fifo", 0.0)
    assert is_command("/cmd_vel", TWIST, (TWIST,))
    assert is_command("/arm/goal", "x/msg/Y", ("arm/goal",))
    assert not is_command("alarm/goal", "x/msg/Y", ("arm/*",))
    with pytest.raises(ConfigError, match="neither a type such as"):
        build(RobotConfig, {"robot": 1, "commands": ["two words"]})


def test_a_lifespan_of_the_publishers_goes_before_the_default() -> None:
    end = robot().end.messages
    end.follow(0, PublisherQos(lifespan_s=2.0))
    assert end.queue(0) == ("deadline", 2.0)
    end.follow(0, PublisherQos(depth=1))
    assert end.queue(0) == ("latest", COMMAND_DEADLINE_S)


@pytest.mark.parametrize("follows", [True, False])
def test_what_repair_brings_too_late_is_dropped_by_the_receiver_and_has_a_row(follows: bool) -> None:
    """The packet with the command is lost, and comes half a second after the packets behind it."""
    sender = robot()
    receiver = Robot(2, commands=(), deadlines={} if follows else {"cmd_vel": 0.0})
    air = Air(sender, receiver)
    air.run(2.0)
    held: list[bytes] = []
    for number in range(4):
        sender.end.messages.submit(number > 0, b"%d" % number * 40, air.now)
        packet = sender.slot(air.now)
        assert packet is not None
        if number:
            receiver.receive(packet, air.now)
        else:
            held.append(packet)
    before = len(receiver.events)
    receiver.receive(held[0], air.now + 0.5)
    events = [event for event in receiver.events[before:] if isinstance(event, Delivered | Lost)]
    (outcome,) = (event for event in events if event.topic_id == 0)
    assert isinstance(outcome, Delivered) != follows
    assert sum(isinstance(event, Delivered) for event in events if event.topic_id == 1) == 3
    assert receiver.end.received.lost[1, 0, "late"] == follows


def test_a_command_that_only_fills_a_repair_counts_from_the_packet_before_it() -> None:
    """Where packets are full, a repair has no room to say which of its span it leaves out: it has all of them, and so
    also a command between the parts of a text, however old that is."""
    topics = Registry([Topic(0, "cmd_vel", TWIST), Topic(1, "text", "std_msgs/msg/String")])
    sender, receiver = Robot(1, topics, hears=False, expected_loss=0.6), Robot(2)
    air, texts = Air(sender, receiver), [b"a" * 150, b"b" * 150]
    air.run(3.0)
    air.lost = lambda _, __: True
    for text in texts:
        sender.end.messages.submit(1, text, air.now)
        air.run(4 * SLOT_S)
        sender.end.messages.submit(0, b"go " + text[:1], air.now)
        air.run(SLOT_S)
    air.run(1.0)
    air.lost = lambda _, __: False
    air.run(2.0)
    assert receiver.delivered() == texts
    assert receiver.end.received.lost[1, 0, "late"]


def test_a_robot_that_hears_nobody_sends_beacons_alone_until_it_hears_somebody() -> None:
    def packets(beacon_s: float) -> tuple[int, int]:
        lone = Robot(1, robot().topics, beacon_s=beacon_s)
        air = Air(lone)
        for _ in range(300):
            lone.end.messages.submit(1, bytes(40), air.now)
            air.run(0.1)
        alone = len(air.recorded)
        air.robots.append(Robot(2))
        took = air.run(30.0, lambda: bool(air.robots[1].delivered()))
        for _ in range(10):
            lone.end.messages.submit(1, bytes(40), air.now)
            air.run(0.1)
        assert took < beacon_s + 2
        assert len(air.robots[1].delivered()) >= 10
        return alone, len(air.recorded) - alone

    always, sparse = packets(1e9), packets(5.0)
    assert sparse[0] < 0.3 * always[0], "5 s of messages, then one hello per 5 s"
    with pytest.raises(ConfigError, match="beacon_s = 5: this end never hears anybody"):
        Robot(1, robot().topics, beacon_s=5.0, hears=False)


def test_with_a_small_share_of_the_air_a_robot_says_as_much_less_about_itself() -> None:
    def kinds(share: float) -> tuple[int, int]:
        one, two = (Robot(n, robot().topics, airtime_share=share) for n in (1, 2))
        air = Air(one, two)
        for _ in range(60):
            air.run(1.0)
            one.end.messages.submit(1, b"x", air.now)
        assert len(two.delivered()) >= 59
        return one.end.sent.air["hello"], two.end.sent.air["report"]

    (hellos, reports), (few_hellos, few_reports) = kinds(1.0), kinds(0.05)
    assert few_hellos < hellos / 4
    assert few_reports <= reports / 2


@pytest.mark.parametrize("own", [True, False])
@pytest.mark.parametrize(("mode", "seed"), [("none", 3), ("none", 4), ("encrypt", 0), ("encrypt", 5)])
def test_a_command_in_a_packet_that_is_sent_again_for_another_message_is_not_new(
    mode: SealMode, seed: int, own: bool
) -> None:
    """A robot is cut off, and then does not get through for longer than it is cut off: what is heard of it first may be
    a packet that it sends again.

    :param own: whether the sender says that commands come in time; otherwise the receivers do
    """
    sends: dict[str, Any] = {} if own else {"commands": ()}
    takes: dict[str, Any] = {} if own else {"deadlines": {"cmd_vel": COMMAND_DEADLINE_S}}
    sender = Robot(1, robot().topics, mode=mode, packet_len=200, **sends)
    receivers = [Robot(src_id, mode=mode, packet_len=200, **takes) for src_id in (2, 3, 4)]
    air = Air(sender, *receivers, loss=0.4, seed=seed)
    by_chance, rng = air.lost, random.Random(seed)
    off, back = 12.0 + (3, 5, 0.8)[seed % 3], (1, 3, 0, 1)[seed % 4]

    def lost(one: Robot, other: Robot) -> bool:
        cut_off = 12 < air.now < off and sender in (one, other)
        return cut_off or (off <= air.now < off + back and one is sender) or by_chance(one, other)

    air.lost = lost
    air.run(2.0)
    ages: list[float] = []
    while air.now < 32:
        if rng.random() < 0.3:
            sender.end.messages.submit(0, b"%f" % air.now, air.now)
        if rng.random() < 0.3:
            sender.end.messages.submit(1, b"%f" % air.now, air.now)
        for _ in range(8):
            air.step()
            for receiver in receivers:
                events = [event for event in receiver.events if isinstance(event, Delivered) and event.topic_id == 0]
                ages += [air.now - float(event.payload) for event in events]
                receiver.events.clear()
    assert len(ages) > 80
    assert max(ages) < 2 * COMMAND_DEADLINE_S
