"""Nothing acts late over hops: what has to be fresh counts from its origin, whoever has kept it."""

from __future__ import annotations

import random
from typing import Any

import pytest

from gr_ros2.core.errors import ConfigError
from gr_ros2.core.tuning import Tuning
from gr_ros2.link.events import Delivered, ReceiverEvent
from gr_ros2.link.queues import PublisherQos
from gr_ros2.link.v1.order import Ready
from gr_ros2.link.v1.relaying import Relaying
from gr_ros2.link.v1.sealing import SealMode
from gr_ros2.relay.robots import QUIET_S
from gr_ros2.settings.commands import COMMAND_DEADLINE_S
from gr_ros2.settings.config import SendOptions
from gr_ros2.settings.registry import CALLS_TYPE, Registry, Topic
from gr_ros2.wire.relayed import Relayed, write_relayed
from gr_ros2.wire.v1 import RELAYED_TOPIC
from tests.link.v1.air import SLOT_S, Robot, registry
from tests.link.v1.test_commands import TWIST
from tests.link.v1.test_custody import custody_of, line_of, named
from tests.link.v1.test_relaying import Line, robot

TUNING = Tuning()

MODES: tuple[SealMode, ...] = ("none", "encrypt")
COMMANDS = Registry([Topic(0, "cmd_vel", TWIST)])


def relaying_of(one: Robot) -> Relaying:
    assert one.end._receiving.relaying is not None
    return one.end._receiving.relaying


def absent(line: Line, *robots: int) -> None:
    """These robots neither hear nor are heard."""
    line.near = lambda one: [  # type: ignore[method-assign]
        other
        for other in (one - 1, one + 1)
        if 0 <= other < len(line.robots) and not {line.robots[one].src_id, line.robots[other].src_id} & set(robots)
    ]


@pytest.mark.parametrize(("off_s", "mode"), [(2.0, "encrypt"), (3600.0, "none")])
def test_the_last_command_of_a_robot_that_is_off_is_not_handed_to_one_that_comes(mode: SealMode, off_s: float) -> None:
    line = Line(robot(1, mode, COMMANDS), *(robot(src_id, mode) for src_id in (2, 3)))
    absent(line, 3)
    line.run(10)
    assert line.robots[1].delivered(1)
    absent(line, 1, 3)
    line.run(min(off_s, 15.0))
    line.now += max(off_s - 15.0, 0.0)
    line._messages = int(line.now / 0.3)
    absent(line, 1)
    line.run(30)
    assert line.robots[2].delivered(2)
    assert not line.robots[2].delivered(1)


@pytest.mark.parametrize(("away_s", "mode"), [(5.0, "none"), (3600.0, "encrypt")])
def test_goals_with_a_deadline_that_a_relay_holds_are_over_after_it(mode: SealMode, away_s: float) -> None:
    rows = named(3, queue="deadline", deadline_s=2.0)
    line = line_of(robot(1, mode, rows), *(robot(src_id, mode) for src_id in (2, 3)), loss=0.0)
    last = line.robots[-1]
    absent(line, 3)
    for n in range(5):
        line.robots[0].end.messages.submit(1, b"goal %d" % n, line.now)
    line.run(1)
    assert len(custody_of(line.robots[1])) == 5
    line.run(4)
    line.now += away_s - 5.0
    line._messages = int(line.now / 0.3)
    absent(line)
    line.run(30)
    assert not any(payload.startswith(b"goal") for payload in last.delivered(1))
    assert line.robots[1].end.received.dropped["too_old"] == 5
    line.robots[0].end.messages.submit(1, b"now", line.now)
    line.run(2)
    assert b"now" in last.delivered(1)


@pytest.mark.parametrize(("loss", "mode"), [(0.0, "encrypt"), (0.2, "none")])
def test_commands_over_hops_count_from_their_origin(mode: SealMode, loss: float) -> None:
    line = Line(robot(1, mode, COMMANDS), *(robot(src_id, mode) for src_id in (2, 3, 4)), loss=loss)
    ages: dict[int, list[float]] = {one.src_id: [] for one in line.robots}
    given: dict[bytes, float] = {}
    submit = line.robots[0].end.messages.submit

    def submitted(topic_id: int, payload: bytes, now: float) -> None:
        given[payload] = now
        submit(topic_id, payload, now)

    line.robots[0].end.messages.submit = submitted  # type: ignore[assignment,method-assign]
    for one in line.robots:

        def received(data: bytes, now: float, began: float | None = None, one: Robot = one) -> list[ReceiverEvent]:
            events = Robot.receive(one, data, now, began)
            ages[one.src_id] += [now - given[e.payload] for e in events if isinstance(e, Delivered) and e.src_id == 1]
            return events

        one.receive = received  # type: ignore[method-assign]
    line.run(60)
    assert len(ages[2]) > 100
    assert len(ages[3]) > 20
    # An eighth of what it may wait is not told; and what had to be repaired counts from the next message, 0.3 s later.
    most = COMMAND_DEADLINE_S * (1 + 1 / TUNING.age_part) + (0.3 if loss else 0.0) + 2 * SLOT_S
    assert max(ages[2] + ages[3] + ages[4]) <= most


@pytest.mark.parametrize("mode", MODES)
def test_a_call_that_a_relay_holds_is_over_after_its_deadline(mode: SealMode) -> None:
    rows = Registry([Topic(0, "odom", "std_msgs/msg/String"), Topic(1, "calls", CALLS_TYPE)])
    line = line_of(robot(1, mode, rows), *(robot(src_id, mode) for src_id in (2, 3)), loss=0.0)
    line.robots[0].end.messages.follow(1, PublisherQos(lifespan_s=60.0))
    line.run(6)
    absent(line, 3)
    line.robots[0].end.messages.submit(1, b"call", line.now, 3.0, 3)
    line.run(1)
    assert len(custody_of(line.robots[1])) == 1
    line.run(5)
    absent(line)
    line.run(20)
    assert b"call" not in line.robots[2].delivered(1)
    assert line.robots[1].end.received.dropped["too_old"] == 1


@pytest.mark.parametrize(("after_s", "comes"), [(0.1, {b"go", b"text"}), (5.0, {b"text"}), (3600.0, set())])
def test_what_waited_for_a_hello_counts_from_when_it_came(after_s: float, comes: set[bytes]) -> None:
    rows = Registry([Topic(0, "cmd_vel", TWIST), Topic(1, "text", "std_msgs/msg/String")])
    sender, receiver = Robot(1, rows, packet_len=128), Robot(2, packet_len=128)
    sender.end.messages.submit(0, b"go", 0.0)
    sender.end.messages.submit(1, b"text", 0.0)
    packets = [data for n in range(6) if (data := sender.slot(n * SLOT_S)) is not None]
    hellos = [data for data in packets if Robot(3, packet_len=128).receive(data, 0.0)]
    assert 0 < len(hellos) < len(packets)
    for data in packets:
        if data not in hellos:
            receiver.receive(data, 0.1)
    for data in hellos:
        receiver.receive(data, 0.1 + after_s)
    assert set(receiver.delivered()) == comes


@pytest.mark.parametrize(("limit_s", "comes"), [(1.0, False), (60.0, True), (0.0, True)])
def test_max_age_s_of_a_receiver_counts_from_the_origin(limit_s: float, comes: bool) -> None:
    rows = named(3)
    line = line_of(robot(1, topics=rows), robot(2), robot(3, max_ages={"g*": limit_s} if limit_s else {}), loss=0.0)
    absent(line, 3)
    line.robots[0].end.messages.submit(1, b"goal", line.now)
    line.run(5)
    absent(line)
    line.run(20)
    assert (b"goal" in line.robots[2].delivered(1)) == comes
    assert comes or line.robots[2].end.received.dropped["too_old"]


def test_nothing_of_a_robot_is_sent_on_long_after_it_was_there() -> None:
    line = Line(*(robot(src_id) for src_id in (1, 2, 3)))
    line.run(10)
    assert any(stream.origin == 1 for stream in relaying_of(line.robots[1]).sent_on._newest)
    absent(line, 1)
    line.run(QUIET_S + 20)
    assert not any(stream.origin == 1 for one in line.robots[1:] for stream in relaying_of(one).sent_on._newest)


def test_commands_are_not_kept_for_late_robots() -> None:
    latched = Registry([Topic(0, "cmd_vel", TWIST, SendOptions(durability="transient_local"))])
    end = robot(1, topics=latched).end
    end.messages.submit(0, b"go", 0.0)
    assert not end.messages.kept.marks(100.0)
    assert not end.messages.sent[0].announced("").latched
    with pytest.raises(ConfigError, match="leave keep_s out"):
        robot(1, topics=Registry([Topic(0, "cmd_vel", TWIST, SendOptions(keep_s=5.0))]))
    with pytest.raises(ConfigError, match="leave keep_s out"):
        robot(1, topics=COMMANDS).end.messages.change(0, SendOptions(keep_s=5.0))


def test_a_kept_message_is_not_sent_again_after_its_deadline() -> None:
    rows = registry(map=SendOptions(durability="transient_local", queue="deadline", deadline_s=2.0))
    one, later = Robot(1, rows), 1.5
    one.end.messages.submit(0, b"map", 0.0)
    for slot in range(5):
        one.slot(slot * SLOT_S)
    assert one.end.messages.kept.marks(later)
    assert not one.end.messages.kept.marks(2.5)


def test_ages_in_a_mesh_are_never_less_than_the_truth() -> None:
    """Random outages and losses: what is known of when a message was made is not later than it was submitted, but for
    the time in a queue of the origin and the slot in which a packet came again as it was."""
    line = Line(*(robot(src_id, "encrypt") for src_id in range(1, 6)), loss=0.2)
    given: dict[bytes, float] = {}
    seen: list[float] = []
    rng = random.Random(3)
    for one in line.robots:
        submit = one.end.messages.submit

        def submitted(topic_id: int, payload: bytes, now: float, submit: Any = submit) -> None:
            given[payload] = now
            submit(topic_id, payload, now)

        one.end.messages.submit = submitted  # type: ignore[assignment,method-assign]
        relaying = relaying_of(one)
        keep = relaying.sent_on.take

        def taken(via: int, kept: Any, now: float, keep: Any = keep) -> bool:
            if kept.message.payload in given:
                seen.append(kept.made - given[kept.message.payload])
            return bool(keep(via, kept, now))

        relaying.sent_on.take = taken  # type: ignore[method-assign]
    for _ in range(20):
        absent(line, *(src_id for src_id in range(1, 6) if rng.random() < 0.2))
        line.run(3)
    assert len(seen) > 500
    assert max(seen) < 1.0


@pytest.mark.parametrize("mode", MODES)
def test_a_message_that_seemed_older_than_it_is_does_not_come_again(mode: SealMode) -> None:
    """In a packet that had to be repaired it seems as old as the packet before; over another robot it came at once."""
    line = Line(*(robot(src_id, mode) for src_id in (1, 2, 3)))
    line.run(10)
    last = relaying_of(line.robots[2])
    number = line.robots[0].end.window.packets.newest + 1
    events: list[Any] = []
    for later, text, seems_s in ((1, b"second", 40.0), (1, b"second", 0.0), (0, b"first", 0.0)):
        message = Relayed(1, line.robots[0].boot & 0xFFFF, number + later, 0, 0, 1, text, age=0)
        came = Ready(RELAYED_TOPIC, (1, 0), write_relayed(message), 0, False, True, made=line.now - seems_s)
        last.receive(2, came, line.now)
        events += last.far._outcomes.take()
    assert [event.payload for event in events if isinstance(event, Delivered)] == [b"second"]
