"""Clouds that fit the air, over the engine of a link: cells of the size that has room, and odometry beside them."""

from __future__ import annotations

import re
from functools import cache

import numpy as np
import pytest

from gr_ros2.codecs.messages import CLOUD, read
from gr_ros2.core.errors import ConfigError
from gr_ros2.link.events import Accepted, Refused
from gr_ros2.link.fates import Fate
from gr_ros2.settings.config import SendOptions
from gr_ros2.settings.registry import Registry, Topic
from tests.codecs import scenes
from tests.codecs.camera_link import ODOMETRY, Air, Robot

POINTS, RATE = 0, 10
FITTING = {"voxel": 0.05, "range": 30.0, "fit": True}


street = cache(scenes.street)


@cache
def scan(number: int) -> bytes:
    """A scan of 16 beams with its number as its time."""
    return scenes.cloud(street(number % 5, 16, 900), number=number)


def number_of(message: bytes) -> int:
    stamp = read(CLOUD, message).header.stamp
    return round((stamp.sec - 1_700_000_000) * 10 + stamp.nanosec / 1e8)


def link(kbit_s: float = 128, loss: float = 0.0, receivers: int = 1, cloud: bool = True, **options: float) -> Air:
    rows = [
        Topic(POINTS, "points", CLOUD, SendOptions(cloud=FITTING, **options)),
        Topic(ODOMETRY, "odom", "std_msgs/msg/String", SendOptions(queue="latest", codec="none")),
    ]
    sender = Robot(1, Registry(rows), kbit_s)
    air = Air(sender, *(Robot(2 + number, None, kbit_s) for number in range(receivers)), loss=loss)
    if cloud:
        air.feed(sender, POINTS, RATE, scan)
    air.feed(sender, ODOMETRY, 20, lambda number: number.to_bytes(4, "big") * 12)
    return air


def ages(seen: list[tuple[float, float]], begin: float, end: float) -> float:
    """Mean age of the newest, s."""
    when, made = np.array([(-1.0, -10.0), *seen]).T
    at = np.arange(begin, end, 0.005)
    return float((at - made[np.searchsorted(when, at, "right") - 1]).mean())


def cloud_ages(robot: Robot, begin: float, end: float) -> float:
    return ages([(now, number_of(message) / RATE) for now, message in robot.of(1, POINTS)], begin, end)


def odometry_ages(robot: Robot, begin: float, end: float) -> float:
    seen = [(now, int.from_bytes(message[:4], "big") / 20) for now, message in robot.of(1, ODOMETRY)]
    return ages(seen, begin, end)


@pytest.mark.parametrize(("kbit_s", "loss"), [(128, 0.2), (512, 0.0)])
def test_clouds_are_young_in_order_and_hold_odometry_up_little(kbit_s: float, loss: float) -> None:
    air, alone = link(kbit_s, loss), link(kbit_s, loss, cloud=False)
    for one in (air, alone):
        one.run(6.0)
    receiver = air.robots[1]
    numbers = [number_of(message) for _, message in receiver.of(1, POINTS)]
    assert numbers == sorted(set(numbers))
    assert len([now for now, _ in receiver.of(1, POINTS) if now > 2]) > 4 * 7
    assert cloud_ages(receiver, 2, 6) < (0.3 if loss else 0.2)
    assert odometry_ages(receiver, 2, 6) < 1.5 * odometry_ages(alone.robots[1], 2, 6)
    assert not receiver.failed


def test_cells_are_as_small_as_the_air_allows() -> None:
    """With the option fit."""

    def points(kbit_s: float) -> int:
        air = link(kbit_s)
        air.run(3.0)
        return int(read(CLOUD, air.robots[1].of(1, POINTS)[-1][1]).width)

    found = [points(kbit_s) for kbit_s in (64, 256, 4000)]
    assert 3 * found[0] < found[1]
    assert 2 * found[1] < found[2]


def test_fewer_clouds_are_finer() -> None:
    air = link(max_rate=2.0)
    air.run(5.0)
    seen = [message for now, message in air.robots[1].of(1, POINTS) if now > 1]
    assert 7 <= len(seen) <= 9
    every = link()
    every.run(3.0)
    assert read(CLOUD, seen[-1]).width > 2 * read(CLOUD, every.robots[1].of(1, POINTS)[-1][1]).width


def test_after_an_outage_and_for_a_joiner_a_young_cloud_is_there_soon() -> None:
    air = link(receivers=2)
    late, lost = air.robots[2], air.lost
    late.on = False
    air.run(3.0)
    air.lost = lambda _, __: True
    air.run(5.0)
    air.lost, late.on = lost, True
    air.run(5.6)
    assert cloud_ages(air.robots[1], 5.4, 5.6) < 0.3
    assert late.of(1, POINTS)


def test_a_cloud_that_cannot_be_made_cells_passes_exactly_or_has_a_fate(caplog: pytest.LogCaptureFixture) -> None:
    air = link(kbit_s=1000)
    sender, receiver = air.robots
    far = scenes.cloud(np.array([[[1e9, 0, 0, 1], [-1e9, 0, 0, 1]]], float), number=13)
    flat = scenes.cloud(np.ones((1, 4, 4)), layout=(("x", 0, 7), ("y", 4, 7)), number=15)
    odd = {13: far, 15: flat, 17: scan(17)[:-500]}
    air._feeds[0] = sender, POINTS, RATE, lambda number: odd.get(number, scan(number)), 0
    air.run(4.0)
    refused = [event for event in sender.events if isinstance(event, Refused) and event.reason == Fate.DAMAGED]
    assert len(refused) == 1
    seen = {number_of(message): message for _, message in receiver.of(1, POINTS)}
    assert seen[15] == flat
    assert read(CLOUD, seen[13]).width == 0, "beyond its range"
    assert max(seen) > 35
    assert len([record for record in caplog.records if "exactly, not as cells" in record.message]) == 1


def test_what_is_said_of_a_cloud() -> None:
    air = link()
    air.run(4.0)
    said = air.robots[0].sender.stats(POINTS, air.now)
    assert said is not None
    assert re.match(r"voxels of 0\.\d+ m instead of 0\.05 m; without \d+ of", said["made"]), said["made"]
    assert re.fullmatch(r"points: 3\.\d MB/s as it is, sent as 10 frames/s in \d+ kbit/s, 0\.\d s old", said["words"])
    sent = [len(event.payload) for event in air.robots[0].events if isinstance(event, Accepted) and not event.topic_id]
    assert max(sent[10:]) < 128e3 / 8 / RATE
    assert np.mean(sent[10:]) > 0.4 * 128e3 / 8 / RATE


@cache
def small(number: int) -> bytes:
    """A small one."""
    return scenes.cloud(street(number % 5, 16, 200), number=number)


@pytest.mark.parametrize("loss", [0.0, 0.2])
def test_the_options_of_a_cloud_change_while_it_is_seen(loss: float) -> None:
    """Exact, as cells, as cells that fit the air, and back; each cloud that comes out is one that was sent."""
    air = link(kbit_s=2000, loss=loss)
    sender, receiver = air.robots
    air._feeds[0] = sender, POINTS, RATE, small, 0
    for cloud in ({}, {"voxel": 1.0}, FITTING, {"voxel": 2.0, "range": 20.0}, FITTING | {"range": 10.0}, {}):
        sender.change(SendOptions(cloud=cloud, queue="latest"))
        begin = air.now + 1.0
        air.run(begin + 1.0)
        seen = [message for now, key, message in receiver.seen if now > begin and sender.camera.topic_id == key[1]]
        assert seen or (loss and not cloud), "of an exact cloud some packet is lost, and a newer one takes its place"
        for message in seen:
            out = read(CLOUD, message)
            if not cloud:
                assert message == small(number_of(message))
            else:
                assert [field.name for field in out.fields] == ["x", "y", "z"]
                places = np.frombuffer(out.data, "<f4").reshape(-1, 3)
                assert len(places)
                assert np.linalg.norm(places, axis=1).max() < cloud.get("range", 200.0) + cloud["voxel"]
                assert (len(places) < 1000) == ("fit" not in cloud)
    numbers = [number_of(message) for _, key, message in receiver.seen if key[1] != ODOMETRY]
    assert numbers == sorted(numbers)


def test_the_cells_of_a_latched_cloud_cannot_change() -> None:
    topic = Topic(POINTS, "points", CLOUD, SendOptions(durability="transient_local"))
    sender = Robot(1, Registry([topic]), 128).sender
    sender.check(POINTS, SendOptions(durability="transient_local", max_rate=1.0))
    with pytest.raises(ConfigError, match=r"^topic points: cloud cannot change while its newest message is kept"):
        sender.check(POINTS, SendOptions(durability="transient_local", cloud={"voxel": 1.0}))
