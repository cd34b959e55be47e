"""Topics become known row by row, and what is sent again adds up, where no report says what is missing."""

from __future__ import annotations

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gr_ros2.link.events import Announced, SentPacket
from gr_ros2.link.v1.reassembly import Reassembly
from gr_ros2.link.v1.sealing import SealMode
from gr_ros2.settings.config import SendOptions
from gr_ros2.settings.registry import CALLS_TYPE, Registry, Topic
from gr_ros2.wire.table import AnnouncedTopic
from gr_ros2.wire.v1 import TABLE_TOPIC, PacketV1, Part
from tests.link.v1.air import Air, Robot, registry
from tests.link.v1.test_ages import MODES
from tests.link.v1.test_waits import hold_back

NAMES = [f"subsystem_{n % 7}/sensor_{n}" for n in range(40)]
DEFAULT, LATCHED = SendOptions(), SendOptions(durability="transient_local")


def rows(robot: Robot) -> tuple[AnnouncedTopic, ...]:
    """The topics of the other robot, as far as they are known."""
    return next((event.topics for event in reversed(robot.events) if isinstance(event, Announced)), ())


def one_way(
    *names: str, loss: float, seed: int = 1, options: SendOptions = DEFAULT, **settings: float
) -> tuple[Robot, Robot, Air]:
    topics = registry(**dict.fromkeys(names, options))
    one, two = Robot(1, topics, hears=False, repair="off", **settings), Robot(2, hears=False)
    return one, two, Air(one, two, loss=loss, seed=seed)


@pytest.mark.parametrize("seed", range(4))
def test_a_long_table_is_known_although_it_never_arrives_as_a_whole(seed: int) -> None:
    """40 topics in packets of 64 bytes, of which a tenth is lost: not one table in a hundred is complete."""
    one, two, air = one_way(*NAMES, loss=0.1, seed=seed)
    sent = 0
    while air.now < 30.0:
        for topic_id in range(len(NAMES)):
            one.end.messages.submit(topic_id, b"%d" % sent, air.now)
            sent += 1
            air.run(1.0 / len(NAMES))
    assert [row.name for row in rows(two)] == NAMES
    assert len(two.delivered()) >= 0.85 * sent
    assert two.end.messages.idle


@pytest.mark.parametrize("seed", range(4))
def test_a_receiver_that_is_switched_on_later_knows_the_topics_in_two_seconds(seed: int) -> None:
    _, two, air = one_way(*NAMES[:6], loss=0.0, seed=seed)
    air.robots.remove(two)
    air.run(20.0 + random.Random(seed).random() * 10)
    air.robots.append(two)
    assert air.run(9.0, lambda: len(rows(two)) == 6) <= 2.0


def test_where_a_long_message_leaves_no_room_it_knows_them_when_the_table_is_repeated() -> None:
    one, two, air = one_way(*NAMES[:2], loss=0.0, repeat_s=10.0)
    air.robots.remove(two)
    one.end.messages.submit(0, bytes(1_000_000), air.now)
    air.run(15.0)
    air.robots.append(two)
    assert air.run(30.0, lambda: len(rows(two)) == 2) <= 10.5
    assert not one.end.messages.idle, "the message is still on its way"


def test_so_does_one_that_a_robot_cannot_hear_while_it_says_something() -> None:
    one, two = Robot(1, registry(**dict.fromkeys(NAMES[:6], DEFAULT))), Robot(2)
    air = Air(one)
    while air.now < 60.0:
        one.end.messages.submit(0, b"something", air.now)
        air.run(0.5)
    air.lost = lambda sender, _: sender is two
    air.robots.append(two)
    begin = air.now
    while len(rows(two)) < 6:
        one.end.messages.submit(0, b"something", air.now)
        air.run(0.5, lambda: len(rows(two)) == 6)
    assert air.now - begin <= 2.5
    silent = one.end.sent.packets
    air.run(60.0)
    assert one.end.sent.packets - silent < 60 * 75 / 20, "a robot that says nothing falls silent"


def test_a_start_whose_first_second_is_lost_is_made_up_for_in_two_seconds() -> None:
    _, two, air = one_way(*NAMES[:6], loss=0.0)
    air.lost = lambda *_: air.now < 1.2
    air.run(1.2)
    assert air.run(9.0, lambda: len(rows(two)) == 6) <= 2.0


@pytest.mark.parametrize("hears", [True, False])
def test_a_row_that_changes_is_told_alone_and_one_that_ends_is_gone(hears: bool) -> None:
    one = Robot(1, registry(**dict.fromkeys(NAMES, SendOptions())), hears=hears)
    two = Robot(2, hears=hears)
    air = Air(one, two)
    air.run(5.0)
    before = one.end.sent.repeats
    one.end.messages.change(3, SendOptions(qos="bulk"))
    one.end.messages.offer(5, offered=False)
    air.run(0.3)
    assert one.end.sent.repeats <= before + 2
    known = {row.topic_id: row for row in rows(two)}
    assert known[3].qos == 2 and 5 not in known and len(known) == 39
    one.end.messages.offer(5, offered=True)
    air.run(0.3)
    assert [row.name for row in rows(two)] == NAMES


@pytest.mark.parametrize("seed", range(4))
def test_a_long_latched_message_comes_out_of_several_repeats(seed: int) -> None:
    """Each of its repeats alone arrives whole in one of 10,000 times."""
    one, two, air = one_way("map", loss=0.3, seed=seed, options=LATCHED, repeat_s=1.0)
    message = random.Random(seed).randbytes(1000)
    one.end.messages.submit(0, message, air.now)
    air.run(20.0, lambda: bool(two.delivered()))
    assert two.delivered() == [message]
    air.run(5.0)
    assert two.delivered() == [message]


def test_a_status_says_that_no_table_arrived() -> None:
    one, two, air = one_way(*NAMES[:2], loss=0.0)
    air.lost = lambda *_: bool(one.end.sent.packets and air.recorded[-1][1][0] & 3 != 3)
    air.run(2.0)
    assert not two.end.peers(air.now)[0].no_table, "it may be under way"
    air.run(2.0)
    assert two.end.peers(air.now)[0].no_table
    air.lost = lambda *_: False
    air.run(2.5)
    assert not two.end.peers(air.now)[0].no_table


@given(st.data())
def test_fragments_join_however_they_are_cut_and_in_whatever_order(data: st.DataObject) -> None:
    message = data.draw(st.binary(min_size=2, max_size=200))
    end = len(message)
    cuts = data.draw(st.lists(st.tuples(st.integers(0, end - 1), st.integers(1, end)), max_size=12))
    pieces = [(a, min(a + b, end)) for a, b in cuts]
    missing = sorted(set(range(end)) - {at for a, b in pieces for at in range(a, b)})
    reassembly = Reassembly(1 << 20)
    place = data.draw(st.integers(1, 9))
    found = []
    for number, (a, b) in enumerate([*pieces, *((at, at + 1) for at in missing), (end - 1, end)], 10):
        part = Part(3, message[a:b], number - 5, a, b == end)
        if (whole := reassembly.add(part, number, place, repaired=False, now=0.0)) is not None:
            found.append(whole)
            break
    (whole,) = found
    assert whole.payload() == message
    assert whole.order == whole.newest
    assert reassembly.held == 0


def test_a_peer_has_as_many_topics_as_a_person_counts() -> None:
    """Services and the row of their calls are in the table, too."""
    kinds = ("odom", "std_msgs/msg/String"), ("add", "example_interfaces/srv/AddTwoInts"), ("calls", CALLS_TYPE)
    one = Robot(1, Registry([Topic(n, *kind) for n, kind in enumerate(kinds)]))
    two = Robot(2)
    for topic_id in (1, 2):
        one.end.messages.offer(topic_id, offered=True)
    air = Air(one, two)
    air.run(3.0, lambda: len(rows(two)) == 3)
    (peer,) = two.end.peers(air.now)
    assert (len(rows(two)), peer.topics) == (3, 1)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("topic_id", [TABLE_TOPIC, 0])
def test_what_had_to_wait_for_its_turn_is_sent_again_when_it_is_asked_for(topic_id: int, mode: SealMode) -> None:
    """Its robot is asked three times and can send nothing for long; then one comes that needs it."""
    topics = registry(map=SendOptions(durability="transient_local"), odom=SendOptions(queue="latest"))
    one, late = Robot(1, topics, mode=mode), Robot(3, mode=mode)
    air = Air(one, Robot(2, mode=mode))
    one.end.messages.submit(0, b"map", air.now)
    air.run(5.0)
    for _ in range(3):
        one.end.messages.kept.asked(topic_id, air.now)
        hold_back(one, 6.0, air.run)
        air.run(0.5)
    air.robots.append(late)
    assert air.run(10.0, lambda: b"map" in late.delivered()) <= 3.0


def test_every_row_leaves_however_often_the_table_is_asked_for_meanwhile() -> None:
    """Where it is asked for again before it has left, rows of topics whose messages wait always went first: in a cell
    of six at 50 % loss two rows of six never came."""
    one = Robot(1, registry(text=DEFAULT, path=DEFAULT, scan=DEFAULT, joint_states=DEFAULT), mode="encrypt")
    air = Air(one, Robot(2, mode="encrypt"))
    air.run(5.0)
    for number in range(200):
        one.end.messages.submit(number % 2, b"text %30d" % number, air.now)
    met = len(one.events)
    for _ in range(20):
        one.end.messages.kept.asked(TABLE_TOPIC, air.now)
        air.run(0.02)
        hold_back(one, 1.2, air.run)
    sent = [event.packet for event in one.events[met:] if isinstance(event, SentPacket)]
    parts = [part for packet in sent if isinstance(packet, PacketV1) for part in packet.body if isinstance(part, Part)]
    assert {part.payload[1] for part in parts if part.topic_id == TABLE_TOPIC and not part.offset} == {0, 1, 2, 3}
