"""A sender learns how a type is made up while it runs: receivers are told, and lose nothing meanwhile."""

from __future__ import annotations

import struct

import pytest
from rosbags.typesys import get_types_from_msg

from gr_ros2.compression import LinkCodec
from gr_ros2.compression.link_codec import ANNOUNCED
from gr_ros2.link.events import Lost, SentPacket
from gr_ros2.link.fates import Fate
from gr_ros2.settings.config import SendOptions
from gr_ros2.settings.registry import Registry, Topic
from gr_ros2.wire.table import AnnouncedTopic
from gr_ros2.wire.v1 import TABLE_TOPIC, Part
from tests.link.v1.air import SLOT_S, Air, Robot

THING = "my_msgs/msg/Thing"
TOPICS = Registry([Topic(0, "thing", THING, SendOptions())])
TYPES = get_types_from_msg("int32 number\nfloat64[6] values\n", THING)


def payload(number: int) -> bytes:
    return b"\0\1\0\0" + struct.pack("<ixxxx6d", number, *[number / 8] * 6)


def decoder(rows: tuple[AnnouncedTopic, ...]) -> LinkCodec:
    topics = [Topic(row.topic_id, row.name, row.type_name) for row in rows]
    return LinkCodec(()).of(topics, {row.topic_id: row.codec for row in rows})


def robots(hears: bool) -> tuple[Robot, Robot, LinkCodec]:
    codec = LinkCodec(TOPICS)
    sender = Robot(1, TOPICS, coding=(codec, None), hears=hears, repeat_s=2.0)
    return sender, Robot(2, coding=(None, decoder), hears=hears), codec


def carries_table(sender: Robot) -> bool:
    """Whether the newest packet has a part of the table of topics."""
    sent = [event for event in sender.events if isinstance(event, SentPacket)][-1]
    return any(isinstance(entry, Part) and entry.topic_id == TABLE_TOPIC for entry in sent.packet.entries)


@pytest.mark.parametrize("hears", [True, False])
@pytest.mark.parametrize("table_lost", [False, True])
def test_nothing_is_lost_while_receivers_learn(hears: bool, table_lost: bool) -> None:
    """Also where the new table does not arrive at first: what depends on it waits for it."""
    sender, receiver, codec = robots(hears)
    air = Air(sender, receiver)
    losing = [False]
    air.lost = lambda robot, _: losing[0] and robot is sender and carries_table(sender)
    for number in range(60):
        if number == 20:
            sender.end.messages.learn(THING, TYPES)
            losing[0] = table_lost
        if number == 30:
            losing[0] = False
        sender.end.messages.submit(0, payload(number), air.now)
        air.run(4 * SLOT_S)
    air.run(5.0)
    assert receiver.delivered(1) == [payload(number) for number in range(60)]
    assert codec.encode(0, payload(1))[0] >> 4 == ANNOUNCED
    assert sender.end.messages.kept.digest == next(iter(receiver.end.neighbours.all.values())).inbox.announced.digest


def test_what_is_never_announced_is_lost_by_name_and_memory_is_bounded() -> None:
    sender, receiver, codec = robots(hears=True)
    air = Air(sender, receiver)
    air.run(1.0)
    codec.learn(THING, TYPES)  # and not announced
    for number in range(400):
        sender.end.messages.submit(0, payload(number), air.now)
        air.run(2 * SLOT_S)
    lost = [event for event in receiver.events if isinstance(event, Lost)]
    assert len(lost) >= 400 - 256 - 5 and {event.reason for event in lost} == {Fate.UNKNOWN_DICTIONARY}
    assert not receiver.delivered(1)
    sender.end.messages.learn(THING, TYPES)
    air.run(1.0)
    assert receiver.delivered(1)[-1] == payload(399)


def test_a_table_that_says_the_same_is_not_sent_again() -> None:
    sender, receiver, _ = robots(hears=True)
    air = Air(sender, receiver)
    air.run(2.0)
    sender.end.messages.learn(THING, TYPES)
    air.run(2.0)
    before = sender.end.sent.repeats
    sender.end.messages.learn(THING, TYPES)
    air.run(2.0)
    assert sender.end.sent.repeats == before
