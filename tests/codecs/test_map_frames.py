"""Maps over the engine of a link: what has changed for those who follow, all of it for those who come."""

from __future__ import annotations

import numpy as np
import pytest

from gr_ros2.codecs import CodedTopic
from gr_ros2.codecs.frames import FrameReceiver
from gr_ros2.codecs.messages import GRID
from gr_ros2.link.events import Refused, SentPacket
from gr_ros2.link.fates import Fate
from gr_ros2.settings.config import SendOptions
from gr_ros2.settings.registry import Registry, Topic
from gr_ros2.wire import AnnouncedTopic
from tests.codecs import scenes
from tests.codecs.camera_link import Air, Robot

MAP = Topic(0, "map", GRID, SendOptions(durability="transient_local"))
MAPS = list(scenes.exploring(12))


def distinct(robot: Robot) -> list[bytes]:
    """The maps that come out at a robot: one that is the same as before does not."""
    seen = [message for _, message in robot.of(1, 0)]
    return [message for before, message in zip([b"", *seen], seen, strict=False) if message != before]


def sent_bytes(robot: Robot) -> int:
    """Bytes of maps that have left so far."""
    return sum(len(event.data) for event in robot.events if isinstance(event, SentPacket) and event.kind == "new")


@pytest.mark.parametrize("bad", [0, 3])
@pytest.mark.parametrize("reports", [True, False])
def test_a_bad_map_is_counted_once_and_the_next_passes(bad: int, reports: bool) -> None:
    mapper = Robot(1, Registry([MAP]), 128)
    air = Air(mapper, *[Robot(2, None, 128)] * reports)
    air.feed(mapper, 0, 1, lambda number: MAPS[number][:-1000] if number == bad else MAPS[number])
    air.run(6.0)
    refused = [event for event in mapper.events if isinstance(event, Refused) and event.reason == Fate.DAMAGED]
    assert len(refused) == 1
    assert not reports or distinct(air.robots[1])[-1] in MAPS[4:7]


def test_a_robot_that_joins_after_a_bad_map_gets_the_one_before() -> None:
    mapper, late = Robot(1, Registry([MAP]), 128), Robot(3, None, 128)
    air = Air(mapper, Robot(2, None, 128))
    air.feed(mapper, 0, 1, lambda number: MAPS[number][:-1000] if number == 3 else MAPS[number])
    air.run(3.5)
    air._feeds.clear()
    air.robots.append(late)
    air.run(12.0)
    assert distinct(late) == [MAPS[2]]
    assert sum(isinstance(event, Refused) for event in mapper.events) == 1


def link(loss: float = 0.0, kbit_s: float = 128.0, **values: bool) -> Air:
    mapper = Robot(1, Registry([MAP]), kbit_s, **values)
    air = Air(mapper, Robot(2, None, kbit_s, **values), loss=loss)
    air.feed(mapper, 0, 1, lambda number: MAPS[min(number, len(MAPS) - 1)])
    return air


@pytest.mark.parametrize("loss", [0.0, 0.2])
def test_each_map_comes_out_exactly_and_costs_what_has_changed(loss: float) -> None:
    air = link(loss)
    air.run(11.9)
    _, follower = air.robots
    assert distinct(follower) == MAPS
    assert not follower.failed
    assert len(follower.of(1, 0)) == len(MAPS)


def test_a_late_robot_gets_the_whole_map_by_asking_although_it_does_not_change() -> None:
    air = link()
    mapper, follower = air.robots
    late = Robot(3, None, 128.0)
    late.on = False
    air.robots.append(late)
    air.run(14.0)
    mapper.on = True
    air._feeds.clear()  # the mapper has nothing new to say
    air.run(16.0)
    before = sent_bytes(mapper)
    late.on = True
    late.start()
    air.run(24.0)
    assert distinct(late) == [MAPS[-1]]
    assert distinct(follower) == MAPS
    cost = sent_bytes(mapper) - before
    air.run(34.0)
    assert sent_bytes(mapper) - before - cost < cost / 2, "the map is not sent again and again"


def test_a_robot_that_was_out_of_range_goes_on_from_the_map_that_it_has() -> None:
    air = link()
    _, follower = air.robots
    whole = air.lost
    air.run(4.5)
    air.lost = lambda _, receiver: receiver is follower
    air.run(7.5)
    air.lost = whole
    air.run(20.0)
    assert distinct(follower)[-1] == MAPS[-1]


def test_where_nobody_reports_every_map_is_whole_and_comes_again() -> None:
    air = link(hears=False)
    air.run(12.9)
    late = Robot(3, None, 128.0, hears=False)
    air.robots.append(late)
    air._feeds.clear()
    air.run(30.0)
    assert distinct(late) == [MAPS[-1]]


@pytest.mark.parametrize("large", [0, 3])
def test_a_map_that_is_too_large_is_counted_and_the_next_passes(large: int) -> None:
    mapper, follower = Robot(1, Registry([MAP]), 128), Robot(2, None, 128)
    air = Air(mapper, follower)
    huge = scenes.grid(np.zeros((4100, 4100), np.int8))
    air.feed(mapper, 0, 1, lambda number: huge if number == large else MAPS[number])
    air.run(6.9)
    refused = [event for event in mapper.events if isinstance(event, Refused) and event.reason == Fate.TOO_LARGE]
    assert len(refused) == 1
    assert distinct(follower) == [MAPS[number] for number in range(7) if number != large]
    assert not follower.failed


PATHS = [scenes.path(100 + 20 * n) for n in range(8)]


@pytest.mark.parametrize("loss", [0.0, 0.2])
def test_a_latched_message_that_grows_costs_what_is_new(loss: float) -> None:
    """And a robot that joins has all of it."""
    messages, topic = PATHS, Topic(0, "plan", "nav_msgs/msg/Path", SendOptions(durability="transient_local"))
    planner, follower = Robot(1, Registry([topic]), 256), Robot(2, None, 256)
    air = Air(planner, follower, loss=loss)
    costs = []
    for message in messages:
        planner.submit(0, message, air.now)
        before = sent_bytes(planner)
        air.run(air.now + 4)
        costs.append(sent_bytes(planner) - before)
    assert distinct(follower) == messages
    assert max(costs[1:]) < costs[0] / 2
    late = Robot(3, None, 256)
    air.robots.append(late)
    air.run(air.now + 6)
    assert distinct(late) == messages[-1:]
    assert not follower.failed


def test_a_path_that_is_not_latched_or_has_a_codec_is_a_message_as_any() -> None:
    for options in ({}, {"durability": "transient_local", "codec": "zstd"}):
        assert 0 not in Robot(1, Registry([Topic(0, "plan", "nav_msgs/msg/Path", SendOptions(**options))]), 256).sender


def test_the_memory_for_maps_of_others_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gr_ros2.codecs.frames.MOST_HELD", 3 * 600 * 600)
    receiver, frame = FrameReceiver(), CodedTopic(GRID).encoder().encode(MAPS[0]).data
    for topic_id in range(8):
        receiver.announce((1, topic_id), AnnouncedTopic(topic_id, "map", GRID, codec="frames"))
        receiver.decode((1, topic_id), "map", frame, 0.0)
        assert sum(decoder.held for decoder in receiver._decoders.values()) <= 4 * 600 * 600
    assert len(receiver._decoders) <= 4
