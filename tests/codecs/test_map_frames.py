"""Maps over the engine of a link: what has changed for those who follow, all of it for those who come."""

from __future__ import annotations

import random
from collections.abc import Iterable, Iterator

import numpy as np
import pytest

from gr_ros2.codecs import CodedTopic
from gr_ros2.codecs.base import OF_CHAIN
from gr_ros2.codecs.frames import MOST_CHAINS
from gr_ros2.codecs.messages import CLOUD, GRID, GRID_UPDATE, read
from gr_ros2.codecs.received_frames import MOST_DECODERS, FrameReceiver
from gr_ros2.compression.zstd_frames import Zstd
from gr_ros2.core.errors import CodecError
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


def costs_of(air: Air, robot: Robot, messages: Iterable[bytes], each_s: float) -> list[int]:
    """Bytes that leave after each of some messages of a topic, one every so many s."""
    costs = []
    for message in messages:
        robot.submit(0, message, air.now)
        before = sent_bytes(robot)
        air.run(air.now + each_s)
        costs.append(sent_bytes(robot) - before)
    return costs


def joined(air: Air, kbit_s: float) -> Robot:
    """A robot that comes late, 6 s after it has come."""
    late = Robot(3, None, kbit_s)
    air.robots.append(late)
    air.run(air.now + 6)
    return late


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


def test_a_report_that_is_kept_back_is_waited_for_and_one_that_tells_is_heeded() -> None:
    """Reports become rare while nothing is lost; the first packet after a rest is reported at once all the same. So a
    map is not followed by repairs, and a message that is lost behind one is repaired as soon as a report has come."""
    mapper, follower = Robot(1, Registry([MAP, Topic(1, "stop", "std_msgs/msg/String")]), 128), Robot(2, None, 128)
    air = Air(mapper, follower)
    *maps, last = scenes.exploring(12, 1000)
    costs_of(air, mapper, maps, 2)
    repairs = [len(event.data) for event in mapper.events if isinstance(event, SentPacket) and event.kind == "repair"]
    assert sum(repairs) < 100
    costs_of(air, mapper, [last], 0.8)
    lost = iter([True])
    air.lost = lambda robot, _: robot is mapper and next(lost, False)
    mapper.submit(1, b"stop", air.now)
    air.run(air.now + 0.7)
    assert next(lost, None) is None
    assert [message for _, message in follower.of(1, 1)] == [b"stop"]


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
    costs = costs_of(air, planner, messages, 4)
    assert distinct(follower) == messages
    assert max(costs[1:]) < costs[0] / 2
    assert distinct(joined(air, 256)) == messages[-1:]
    assert not follower.failed


def test_a_latched_cloud_that_grows_costs_what_is_new() -> None:
    points = scenes.street(1, 32, 600)
    clouds = [scenes.cloud(points[: 16 + 4 * n], number=n) for n in range(4)]
    topic = Topic(0, "points", CLOUD, SendOptions(durability="transient_local"))
    mapper, follower = Robot(1, Registry([topic]), 1000), Robot(2, None, 1000)
    air = Air(mapper, follower)
    costs = costs_of(air, mapper, clouds, 3)
    assert distinct(follower) == clouds
    assert costs[0] < len(Zstd(level=9).compress(clouds[0], least=0)), "all of it, as any cloud"
    assert max(costs[1:]) < costs[0]
    assert distinct(joined(air, 1000)) == clouds[-1:]


def test_a_path_that_is_not_latched_or_has_a_codec_is_a_message_as_any() -> None:
    for options in ({}, {"durability": "transient_local", "codec": "zstd"}):
        assert 0 not in Robot(1, Registry([Topic(0, "plan", "nav_msgs/msg/Path", SendOptions(**options))]), 256).sender


def test_the_memory_for_maps_of_others_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gr_ros2.codecs.received_frames.MOST_HELD", 3 * 600 * 600)
    receiver, frame = FrameReceiver(), CodedTopic(GRID).encoder().encode(MAPS[0]).data
    for topic_id in range(8):
        receiver.announce((1, topic_id), AnnouncedTopic(topic_id, "map", GRID, codec="frames"))
        receiver.decode((1, topic_id), "map", frame, 0.0)
        assert sum(decoder.held for decoder in receiver._decoders.values()) <= 4 * 600 * 600
    assert len(receiver._decoders) <= 4


def others() -> Iterator[bytes]:
    """Maps of which nothing but a row is other than in the one before."""
    rng = np.random.default_rng(1)
    cells = rng.integers(-1, 101, (150, 200))
    for row in range(6):
        cells[row] = rng.integers(-1, 101, 200)
        yield scenes.grid(cells, row)


OTHERS = list(others())


def of_two(loss: float = 0.0, receivers: int = 1, seed: int = 1) -> Air:
    """A robot whose map two nodes publish: one explores, the other says something new now and then."""
    mapper = Robot(1, Registry([MAP]), 256)
    mapper.published_by(2)
    return Air(mapper, *(Robot(2 + n, None, 256) for n in range(receivers)), loss=loss, seed=seed)


def say(air: Air, number: int, seconds: float) -> None:
    mapper = air.robots[0]
    mapper.submit(0, MAPS[number], air.now, "explorer")
    if number % 2 == 0:
        mapper.submit(0, OTHERS[number // 2], air.now, "other")
    air.run(air.now + seconds)


def shown(robot: Robot, of: list[bytes]) -> list[bytes]:
    """The different maps of one publisher that come out, in their order."""
    return list(dict.fromkeys(message for _, message in robot.of(1, 0) if message in of))


@pytest.mark.parametrize("loss", [0.0, 0.2])
def test_maps_of_several_publishers_are_changes_of_their_own(loss: float) -> None:
    air = of_two(loss)
    costs = []
    for number in range(8):
        before = sent_bytes(air.robots[0])
        say(air, number, 3.0)
        costs.append(sent_bytes(air.robots[0]) - before)
    mapper, follower = air.robots
    assert shown(follower, MAPS) == MAPS[:8]
    assert shown(follower, OTHERS) == OTHERS[:4]
    assert not follower.failed
    assert max(costs[1:]) < len(CodedTopic(GRID).encoder().encode(OTHERS[0]).data) / 4 < costs[0]
    assert all(event.reason != Fate.SUPERSEDED for event in mapper.events if isinstance(event, Refused))


def test_a_robot_that_joins_gets_the_newest_map_of_each_publisher() -> None:
    air = of_two(receivers=2)
    follower, late = air.robots[1:]
    late.on = False
    for number in range(4):
        say(air, number, 2.0)
    late.on = True
    late.start()
    air.run(air.now + 8)
    assert {message for _, message in late.of(1, 0)} == {MAPS[3], OTHERS[1]}
    assert not late.failed
    say(air, 4, 3.0)
    for robot in (follower, late):
        assert shown(robot, MAPS)[-1] == MAPS[4]
        assert shown(robot, OTHERS)[-1] == OTHERS[2]


@pytest.mark.parametrize("seed", range(2))
def test_receivers_that_lost_different_maps_all_end_with_the_newest(seed: int) -> None:
    """Outages of either, a robot that starts again, and publishers that do."""
    air, rng = of_two(0.1, receivers=2, seed=seed), random.Random(seed)
    usual = air.lost
    for number in range(10):
        away = rng.choice([None, *air.robots[1:]])
        air.lost = lambda sender, receiver, away=away: receiver is away or usual(sender, receiver)
        if number == 5:
            air.robots[1].start()
        mapper = air.robots[0]
        mapper.submit(0, MAPS[number], air.now, ("explorer", number // 4))
        if number % 3 == 0:
            mapper.submit(0, OTHERS[number // 3], air.now, "other")
        air.run(air.now + 1.5)
    air.lost = usual
    say_last = MAPS[10], OTHERS[4]
    air.robots[0].submit(0, say_last[0], air.now, ("explorer", 2))
    air.robots[0].submit(0, say_last[1], air.now, "other")
    air.run(air.now + 15)
    for robot in air.robots[1:]:
        assert shown(robot, MAPS)[-1] == MAPS[10]
        assert shown(robot, OTHERS)[-1] == OTHERS[4]
        assert {message for _, message in robot.of(1, 0)} <= {*MAPS, *OTHERS}


def test_of_many_publishers_the_newest_few_are_kept_and_all_come_out() -> None:
    mapper, follower = Robot(1, Registry([MAP]), 2000), Robot(2, None, 2000)
    mapper.published_by(40)
    air, small = Air(mapper, follower), [scenes.grid(np.full((9, 9), n, np.int8)) for n in range(40)]
    for number, message in enumerate(small):
        mapper.submit(0, message, air.now, number)
        air.run(air.now + 0.2)
    assert shown(follower, small) == small
    assert len(mapper.sender._sent[0].chains) == MOST_CHAINS
    mapper.published_by(1)
    mapper.submit(0, MAPS[0], air.now, 39)
    air.run(air.now + 3)
    assert len(mapper.sender._sent[0].chains) == 1
    assert follower.of(1, 0)[-1][1] == MAPS[0]


def test_where_publishers_are_not_told_apart_the_newest_of_all_are_kept() -> None:
    air = of_two()
    for number in range(4):
        air.robots[0].submit(0, MAPS[number], air.now)
        air.run(air.now + 2)
    late = Robot(3, None, 256)
    air.robots.append(late)
    air.run(air.now + 10)
    assert shown(air.robots[1], MAPS) == MAPS[:4]
    assert {message for _, message in late.of(1, 0)} == set(MAPS[:4])


UPDATES = Topic(1, "map_updates", GRID_UPDATE)


def update(number: int, at: tuple[int, int] = (3, 4), shape: tuple[int, int] = (5, 6)) -> bytes:
    """Changes of a map, whose cells are the number."""
    (x, y), (height, width) = at, shape
    cells = np.full(height * width, number, np.int8)
    return scenes.write(
        GRID_UPDATE, header=scenes.header(number, "map"), x=x, y=y, width=width, height=height, data=cells
    )


def test_changes_of_a_map_become_a_part_of_it() -> None:
    """Nothing of their own leaves; who joins gets the map with them; one that does not fit is counted."""
    mapper, follower = Robot(1, Registry([MAP, UPDATES]), 256), Robot(2, None, 256)
    air = Air(mapper, follower)
    cells, expected = np.zeros((50, 60), np.int8), []
    mapper.submit(1, update(7), air.now)
    air.run(2)
    mapper.submit(0, scenes.grid(cells), air.now)
    expected.append(scenes.grid(cells))
    air.run(4)
    for number in (1, 2, 3):
        mapper.submit(1, update(number, (10 * number, 4)), air.now)
        cells[4:9, 10 * number : 10 * number + 6] = number
        made = read(GRID, scenes.grid(cells))
        made.header.stamp = scenes.header(number).stamp
        expected.append(scenes.write(GRID, **{name: getattr(made, name) for name in ("header", "info", "data")}))
        air.run(air.now + 1)
    before = sent_bytes(mapper)
    mapper.submit(1, update(4, (57, 4)), air.now)
    air.run(air.now + 1)
    assert sent_bytes(mapper) == before
    assert distinct(follower) == expected
    assert [message for _, message in follower.of(1, 1)] == [update(7)], "before there is a map it is a message as any"
    refused = [event for event in mapper.events if isinstance(event, Refused)]
    assert [(event.topic_id, event.reason) for event in refused] == [(1, Fate.DAMAGED)]
    assert mapper.sender.stats(1, air.now)["words"] == "map_updates: 3 messages became part of map"
    late = Robot(3, None, 256)
    air.robots.append(late)
    air.run(air.now + 6)
    assert distinct(late) == expected[-1:]


@pytest.mark.parametrize("options", [{"codec": "zstd"}, {}])
def test_changes_of_a_map_that_is_not_sent_as_frames_pass_as_messages(options: dict[str, str]) -> None:
    rows = [Topic(0, "map" if options else "elsewhere", GRID, SendOptions(durability="transient_local"))]
    mapper, follower = (
        Robot(1, Registry([*rows, Topic(1, "map_updates", GRID_UPDATE, SendOptions(**options))]), 256),
        Robot(2, None, 256),
    )
    air = Air(mapper, follower)
    mapper.submit(0, scenes.grid(np.zeros((50, 60), np.int8)), air.now)
    sent = [update(number) for number in range(5)]
    for message in sent:
        mapper.submit(1, message, air.now)
    air.run(3)
    assert [message for _, message in follower.of(1, 1)] == sent


def test_chains_that_are_made_up_cost_no_more_than_other_topics() -> None:
    receiver, frame = FrameReceiver(), CodedTopic(GRID).encoder().encode(MAPS[0]).data
    receiver.announce((1, 0), AnnouncedTopic(0, "map", GRID, codec="frames"))
    for number in range(256):
        assert receiver.decode((1, 0), "map", bytes([OF_CHAIN, number]) + frame, 10.0 * number) == MAPS[0]
    assert len(receiver._decoders) == MOST_DECODERS
    for cut in (bytes([OF_CHAIN]), bytes([OF_CHAIN, 1]), bytes([OF_CHAIN, 1, OF_CHAIN, 2]) + frame):
        with pytest.raises(CodecError):
            receiver.decode((1, 0), "map", cut, 4000.0)
