"""Robots that say false things of others: an insider that has the key, and anybody where there is none."""

from __future__ import annotations

import pytest

from gr_ros2.link.events import Delivered
from gr_ros2.link.v1.custody import PATIENCE_S
from gr_ros2.link.v1.message import Message
from gr_ros2.link.v1.order import Ready
from gr_ros2.link.v1.sealing import SealMode
from gr_ros2.settings.config import SendOptions
from gr_ros2.settings.registry import Registry, Topic
from gr_ros2.wire.relayed import RECEIPT_TOPIC, Receipt, Relayed, write_carried, write_receipts, write_relayed
from gr_ros2.wire.table import AnnouncedTopic, write_table
from gr_ros2.wire.v1 import CARRIED_TOPIC, RELAYED_TOPIC, TABLE_TOPIC
from tests.link.v1.air import Robot, registry
from tests.link.v1.test_ages import MODES, absent, relaying_of
from tests.link.v1.test_custody import custody_of, named, told, until
from tests.link.v1.test_relaying import Line, robot

LAST_NUMBER, LAST_BOOT = 2**32 - 1, 2**64 - 1
EXPIRES_S = 15.0
ROW = AnnouncedTopic(0, "odom", "std_msgs/msg/String", 1, False, False, 1, "", False, 255)


@pytest.fixture
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    """What was false expires after 15 s."""
    for module in ("relay.gain", "link.v1.delivery", "link.v1.far", "link.v1.sequences"):
        monkeypatch.setattr(f"gr_ros2.{module}.EXPIRES_S", EXPIRES_S)


def says(insider: Robot, false: Relayed, now: float) -> None:
    """This robot sends a message on that nobody has made."""
    passing = relaying_of(insider).sent_on
    offer = passing.offer

    def once(topics, *_):  # type: ignore[no-untyped-def]
        topic = topics[RELAYED_TOPIC]
        if not topic.queue:
            passing.offer = offer  # type: ignore[method-assign]
            passing._offered.pop(RELAYED_TOPIC, None)
            topic.queue.append(Message(-1, RELAYED_TOPIC, write_relayed(false), 1, now, repeat=True))

    passing.offer = once  # type: ignore[method-assign,assignment]


def number(false: int, start: int) -> Relayed:
    return Relayed(1, start & 0xFFFF, false, 0, 0, 1, b"false", age=0)


def table(origin: int, boot: int, at: int, *rows: AnnouncedTopic) -> Relayed:
    payload = boot.to_bytes(8, "big") + write_table(rows)
    return Relayed(origin, boot & 0xFFFF, at, 0, TABLE_TOPIC, 1, payload, age=0)


def carries(insider: Robot, taker: int, false: Relayed, now: float) -> None:
    """This robot hands a message on that nobody has made."""
    queue = insider.end.messages.sent[CARRIED_TOPIC].queue
    queue.append(Message(-1, CARRIED_TOPIC, write_carried(taker, false), 1, now, repeat=True))


def count(one: Robot, line: Line, seconds: float) -> int:
    """Messages of robot 1 that come out in so many s."""
    before = len(one.delivered(1))
    line.run(seconds)
    return len(one.delivered(1)) - before


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("reliable", [False, True])
def test_a_false_number_does_not_silence_a_robot_that_is_heard(mode: SealMode, reliable: bool) -> None:
    topics = Registry(
        [Topic(0, "odom", "std_msgs/msg/String", SendOptions() if reliable else SendOptions(queue="latest"))]
    )
    line = Line(*(robot(src_id, mode, topics) for src_id in (1, 2, 3)))
    line.near = lambda one: [other for other in range(3) if other != one]  # type: ignore[method-assign]
    line.run(10)
    for later in (0, 1, 100, LAST_NUMBER // 2, LAST_NUMBER):
        newest = line.robots[0].end.window.packets.newest
        says(line.robots[1], number(min(newest + later, LAST_NUMBER), line.robots[0].boot), line.now)
        assert count(line.robots[2], line, 6) >= 15
    got = line.robots[2].delivered(1)
    true = [payload for payload in got if payload != b"false"]
    assert len(true) == len(set(true))
    assert true == [payload for src_id, payload in line.said if src_id == 1 and payload in true], "in their order"


@pytest.mark.parametrize("mode", MODES)
def test_a_false_number_silences_a_robot_over_hops_for_a_while_only(mode: SealMode, soon: None) -> None:  # noqa: ARG001
    line = Line(*(robot(src_id, mode) for src_id in (1, 2, 3, 4)))
    line.run(15)
    says(line.robots[3], number(LAST_NUMBER, line.robots[0].boot), line.now)
    line.run(EXPIRES_S + 10)
    assert b"false" in line.robots[2].delivered(1)
    assert count(line.robots[2], line, 10) > 10
    assert count(line.robots[1], line, 10) > 20


@pytest.mark.parametrize("mode", MODES)
def test_a_false_number_of_a_robot_over_hops_does_not_count_when_it_is_heard(mode: SealMode) -> None:
    line = Line(*(robot(src_id, mode) for src_id in (1, 2, 3, 4)))
    line.run(15)
    says(line.robots[3], number(LAST_NUMBER, line.robots[0].boot), line.now)
    line.run(3)
    line.near = lambda one: [other for other in range(4) if other != one]  # type: ignore[method-assign]
    line.run(5)
    assert count(line.robots[2], line, 10) > 20
    assert count(line.robots[3], line, 10) > 20


@pytest.mark.parametrize("mode", MODES)
def test_a_false_start_ends_a_robot_for_a_while_only(mode: SealMode, soon: None) -> None:  # noqa: ARG001
    line = Line(*(robot(src_id, mode) for src_id in (1, 2, 3, 4)))
    line.run(15)
    says(line.robots[3], table(1, LAST_BOOT, 0), line.now)
    line.run(1)
    assert relaying_of(line.robots[2]).far.inboxes[1].boot == LAST_BOOT
    line.run(EXPIRES_S + 10)
    assert count(line.robots[2], line, 10) > 10
    assert count(line.robots[1], line, 10) > 20


@pytest.mark.parametrize("mode", MODES)
def test_a_table_with_a_false_number_stops_reliable_topics_for_a_while_only(mode: SealMode, soon: None) -> None:  # noqa: ARG001
    """The third robot would say for ever that it has all up to there."""
    both = registry(odom=SendOptions(queue="latest"), all=SendOptions())
    line = Line(*(robot(src_id, mode, both) for src_id in (1, 2, 3, 4)))
    line.near = lambda one: {2: [3], 3: [2]}.get(one, [1 - one])  # type: ignore[method-assign]
    line.run(10)
    rows = [AnnouncedTopic(n, name, "std_msgs/msg/String", 0, n == 1) for n, name in enumerate(("odom", "all"))]
    says(line.robots[3], table(1, line.robots[0].boot, LAST_NUMBER, *rows), line.now)
    line.run(2)
    assert relaying_of(line.robots[2]).far.inboxes[1].first > LAST_NUMBER
    del line.near
    line.run(EXPIRES_S + 10)
    for n in range(5):
        line.robots[0].end.messages.submit(1, b"true %d" % n, line.now)
        line.run(1)
    line.run(10)
    assert [text for text in line.robots[2].delivered(1) if text.startswith(b"true")] == [
        b"true %d" % n for n in range(5)
    ]


@pytest.mark.parametrize("mode", MODES)
def test_a_false_table_of_a_robot_that_is_heard_changes_nothing(mode: SealMode) -> None:
    line = Line(*(robot(src_id, mode) for src_id in (1, 2, 3)))
    line.run(10)
    two, known = line.robots[1], line.robots[1].end.topics_of(1)
    boot = line.robots[0].boot
    for false in (table(1, boot, LAST_NUMBER), table(1, boot, 5, ROW), table(1, LAST_BOOT, 5)):
        says(line.robots[2], false, line.now)
        assert count(two, line, 6) >= 15
        assert two.end.topics_of(1) == known
    assert two.end.received.dropped["false_origin"]


def test_a_robot_that_starts_again_takes_the_place_of_its_earlier_start_over_hops() -> None:
    line = Line(*(robot(src_id) for src_id in (1, 2, 3)))
    line.run(10)
    for _ in range(3):
        line.robots[0].start()
        line.run(10)
        assert count(line.robots[2], line, 5) > 5
    streams = relaying_of(line.robots[2]).sent_on._newest
    assert {stream.start for stream in streams if stream.origin == 1} == {line.robots[0].boot}


def heard_over(one: Robot, via: int, said: Relayed, now: float) -> None:
    order = (said.number, 0)
    relaying_of(one).receive(via, Ready(RELAYED_TOPIC, order, write_relayed(said), 0, False, False, made=now), now)


def test_any_number_of_robots_is_known_over_one_neighbour() -> None:
    line = Line(robot(2), robot(3))
    line.run(5)
    one = line.robots[1]
    for origin in range(10, 250):
        heard_over(one, 2, table(origin, 1000, 1, ROW), line.now)
        heard_over(one, 2, Relayed(origin, 1000, 2, 0, 0, 1, b"odom", age=0), line.now)
    line.run(1)
    assert {event.src_id for event in one.events if isinstance(event, Delivered)} >= set(range(10, 250))
    assert len([known for known in one.end.peers(line.now) if known.hops]) == 240


def test_twenty_robots_with_ten_topics_start_twenty_times_and_are_still_relayed() -> None:
    line = Line(robot(2), robot(3), robot(4))
    absent(line, 4)
    line.run(5)
    one, rows = line.robots[1], [ROW._replace(topic_id=n, name=f"odom{n}") for n in range(10)]
    for start in range(1, 21):
        for origin in range(10, 30):
            heard_over(one, 2, table(origin, start, 1, *rows), line.now)
            for topic_id in range(10):
                heard_over(one, 2, Relayed(origin, start, 2, topic_id, topic_id, 1, b"odom", age=0), line.now)
        line.run(0.1)
    streams = relaying_of(one).sent_on._newest
    assert {(stream.origin, stream.start, stream.topic_id) for stream in streams if stream.topic_id < TABLE_TOPIC} >= {
        (origin, 20, topic_id) for origin in range(10, 30) for topic_id in range(10)
    }
    assert len(streams) < 20 * 11 + 20
    absent(line)
    line.run(20)
    got = {(e.src_id, e.topic_id) for e in line.robots[2].events if isinstance(e, Delivered) and e.src_id >= 10}
    assert len(got) > 100


def test_who_brings_much_takes_no_room_of_others(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gr_ros2.link.v1.sent_on.MOST_STREAMS", 20)
    line = Line(robot(1), robot(2), robot(3))
    line.run(10)
    one = line.robots[1]
    rows = [ROW._replace(topic_id=n, name=f"odom{n}") for n in range(100)]
    heard_over(one, 3, table(9, 1, 1, *rows), line.now)
    for topic_id in range(100):
        heard_over(one, 3, Relayed(9, 1, 2, topic_id, topic_id, 1, b"odom", age=0), line.now)
    passing = relaying_of(one).sent_on
    assert len(passing._newest) <= 20
    assert {stream.topic_id for stream in passing._newest if stream.origin == 1} == {0, TABLE_TOPIC}
    assert one.end.received.dropped["relay_full"] > 80


def with_goals(*, cell: bool) -> Line:
    """Robot 1 has goals for 3; it hears 2 alone, or both."""
    line = Line(robot(1, "encrypt", named(3)), *(robot(src_id, "encrypt") for src_id in (2, 3)))
    if cell:
        line.near = lambda one: [other for other in range(3) if other != one]  # type: ignore[method-assign]
    line.run(12)
    return line


def receipt(order: tuple[int, int], line: Line) -> Relayed:
    """Robot 3 has what 1 has made for it up to a message, as another one says."""
    first, _, last = line.robots
    told = write_receipts([Receipt(first.boot & 0xFFFF, 1, *order)])
    newest = last.end.window.packets.newest
    return Relayed(3, last.boot & 0xFFFF, newest, 200, RECEIPT_TOPIC, 1, told, dst_id=1)


@pytest.mark.parametrize("heard", [False, True])
def test_a_false_message_for_one_robot_puts_true_ones_off_for_a_while_only(heard: bool, soon: None) -> None:  # noqa: ARG001
    """Robot 2 makes one up in the name of 1, which 3 hears or does not hear."""
    line = with_goals(cell=heard)
    first, liar, last = line.robots
    carries(liar, 3, Relayed(1, first.boot & 0xFFFF, LAST_NUMBER, 130, 1, 1, b"false", dst_id=3), line.now)
    line.run(2 if heard else EXPIRES_S + 10)
    assert (b"false" in last.delivered(1)) != heard
    goals = [b"goal %d" % n for n in range(10)]
    for goal in goals:
        first.end.messages.submit(1, goal, line.now)
        line.run(1)
    line.run(10)
    assert [payload for payload in last.delivered(1) if payload.startswith(b"goal")] == goals
    assert told(first) == [True] * 10


def test_what_a_false_message_puts_off_comes_soon_once_it_has_expired(soon: None) -> None:  # noqa: ARG001
    """What was refused is handed on again by the rule of the first try, not after twice as long with each."""
    line = with_goals(cell=False)
    first, liar, last = line.robots
    carries(liar, 3, Relayed(1, first.boot & 0xFFFF, LAST_NUMBER, 130, 1, 1, b"false", dst_id=3), line.now)
    line.run(2)
    goals = [b"goal %d" % n for n in range(5)]
    for goal in goals[:-1]:
        first.end.messages.submit(1, goal, line.now)
        line.run(1)
    line.run(100)
    assert not {*goals} & {*last.delivered(1)}
    first.end.messages.submit(1, goals[-1], line.now)
    line.run(PATIENCE_S + 10)
    assert [payload for payload in last.delivered(1) if payload in goals] == goals


def test_a_receipt_of_what_was_never_made_ends_nothing() -> None:
    line = with_goals(cell=False)
    first, liar, _ = line.robots
    line.near = lambda one: [[1], [0], []][one]  # type: ignore[method-assign]
    first.end.messages.submit(1, b"goal", line.now)
    carries(liar, 1, receipt((LAST_NUMBER, 0), line), line.now)
    line.run(3)
    assert first.end.received.dropped["false_origin"] == 1
    assert told(first) == []


def test_a_robot_that_is_heard_tells_itself_what_has_come_there() -> None:
    """3 hears nothing of 1 for a while, and 2 makes a receipt in its name."""
    line = with_goals(cell=True)
    (first, liar, last), near = line.robots, line.near
    line.near = lambda one: [[1, 2], [0, 2], [1]][one]  # type: ignore[method-assign]
    first.end.messages.submit(1, b"goal", line.now)
    line.run(1)
    carries(liar, 1, receipt(custody_of(first)._newest[1, 3], line), line.now)
    line.run(2)
    assert not liar.end.messages.sent[CARRIED_TOPIC].queue
    assert told(first) == [] and b"goal" not in last.delivered(1)
    assert first.end.received.dropped["false_origin"] == 1
    line.near = near  # type: ignore[method-assign]
    until(line, 30, lambda: told(first) == [True] and last.delivered(1).count(b"goal") == 1)
