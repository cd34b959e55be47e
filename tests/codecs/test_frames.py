"""Cameras over the engine of a link: what comes out, how old, and what becomes of joiners, outages and bad pictures."""

from __future__ import annotations

import random
import re
import sys
from collections.abc import Iterable
from contextlib import suppress
from statistics import median
from typing import Any

import numpy as np
import pytest

from gr_ros2.codecs import CodedTopic
from gr_ros2.codecs.messages import CAMERA_INFO, GRID, IMAGE, VIDEO, read
from gr_ros2.codecs.pull import KEY_S
from gr_ros2.codecs.received_frames import MOST_BYTES_S, MOST_DECODERS, FrameReceiver
from gr_ros2.core.errors import BackendMissingError, CodecError, DamagedError, MissingFrameError
from gr_ros2.link.events import Accepted, Delivered, Refused
from gr_ros2.link.fates import Fate
from gr_ros2.settings.config import SendOptions
from gr_ros2.settings.registry import Registry, Topic
from gr_ros2.wire import AnnouncedTopic
from tests.codecs import scenes
from tests.codecs.camera_link import CAMERA, ODOMETRY, SCAN, Air, Robot, registry

FPS = 15
ZERO = {"header": scenes.header(), "height": 0, "width": 0, "encoding": "rgb8", "is_bigendian": 0, "step": 0} | {
    "data": np.zeros(0, np.uint8)
}
RNG = np.random.default_rng(1)
_PICTURES: dict[int, bytes] = {}


def picture(number: int) -> bytes:
    """A picture of a scene in motion that carries its number as its time."""
    if number not in _PICTURES:
        _PICTURES[number] = scenes.image(scenes.view(number, 320, 240), "rgb8", number)
    return _PICTURES[number]


def number_of(message: bytes) -> int:
    stamp = read(IMAGE, message).header.stamp
    return round((stamp.sec - 1_700_000_000) * 10 + stamp.nanosec / 1e8)


def odometry(number: int) -> bytes:
    return number.to_bytes(4, "big") * 12


def link(*, loss: float = 0.0, kbit_s: float = 128, receivers: int = 1, seed: int = 1, **options: Any) -> Air:
    """A robot with a camera, and others that hear it."""
    camera = Robot(1, registry(**options), kbit_s)
    others = (Robot(2 + number, None, kbit_s) for number in range(receivers))
    air = Air(camera, *others, loss=loss, seed=seed)
    air.feed(camera, CAMERA, FPS, picture)
    air.feed(camera, ODOMETRY, 20, odometry)
    return air


def ages(robot: Robot, begin: float, end: float) -> np.ndarray[Any, Any]:
    """How old the newest picture is, s, each 5 ms."""
    seen = [(-1.0, -10.0), *((now, number_of(message) / FPS) for now, message in robot.of(1))]
    when, taken = np.array(seen).T
    at = np.arange(begin, end, 0.005)
    made: np.ndarray[Any, Any] = at - taken[np.searchsorted(when, at, "right") - 1]
    return made


@pytest.mark.parametrize("loss", [0.0, 0.2])
def test_pictures_cross_in_order_and_are_young(loss: float) -> None:
    air = link(loss=loss)
    air.run(6.0)
    sender, receiver = air.robots
    numbers = [number_of(message) for _, message in receiver.of(1)]
    assert numbers == sorted(set(numbers))
    assert not receiver.failed
    assert len([now for now, _ in receiver.of(1) if now > 2]) >= 4 * 13
    assert ages(receiver, 2, 6).mean() < (0.2 if loss else 0.12)
    refused = [event for event in sender.events if isinstance(event, Refused) and event.topic_id == CAMERA]
    assert {event.reason for event in refused} <= {Fate.SUPERSEDED}


def test_what_leaves_is_what_arrives() -> None:
    air = link(loss=0.1)
    arrived: list[bytes] = []
    receiver = air.robots[1]
    take = receiver.take
    receiver.take = lambda events, now: (  # type: ignore[method-assign]
        arrived.extend(e.payload for e in events if isinstance(e, Delivered) and e.topic_id == CAMERA),
        take(events, now),
    )[1]
    air.run(4.0)
    events = air.robots[0].events
    sent = [event.payload for event in events if isinstance(event, Accepted) and event.topic_id == CAMERA]
    assert len(arrived) > 30
    assert arrived == sent[: len(arrived)]


def test_all_pictures_cross_on_a_narrow_link() -> None:
    air = link(kbit_s=32)
    air.run(6.0)
    assert len([now for now, _ in air.robots[1].of(1) if now > 2]) >= 4 * 13
    assert ages(air.robots[1], 2, 6).mean() < 0.15


@pytest.mark.parametrize(("kbit_s", "seconds"), [(128, 5.0), (3.5, 15.0)])
def test_odometry_is_not_much_older_for_it(kbit_s: float, seconds: float) -> None:
    """At 3.5 kbit/s a packet takes half a second, and there is more odometry than the channel carries."""

    def age(*topics: int) -> float:
        sender, receiver = Robot(1, registry(), kbit_s), Robot(2, None, kbit_s)
        air = Air(sender, receiver)
        for topic_id in topics:
            air.feed(sender, topic_id, *((FPS, picture) if topic_id == CAMERA else (20, odometry)))
        air.run(seconds)
        assert CAMERA not in topics or len(receiver.of(1)) > seconds / 5
        seen = [(now, int.from_bytes(message[:4], "big") / 20) for now, message in receiver.of(1, ODOMETRY)]
        when, made = np.array([(0.0, 0.0), *seen]).T
        at = np.arange(seconds / 5, seconds, 0.005)
        return float((at - made[np.searchsorted(when, at, "right") - 1]).mean())

    assert age(ODOMETRY, CAMERA) < 1.5 * age(ODOMETRY)


@pytest.mark.parametrize("ways", [1, 2])
def test_after_an_outage_a_young_picture_is_there_at_once(ways: int) -> None:
    air = link(loss=0.05)
    air.run(4.0)
    lost, air.lost = air.lost, lambda sender, _: ways == 2 or sender is air.robots[0]
    air.run(6.0)
    air.lost = lost
    air.run(7.0)
    fresh = np.flatnonzero(ages(air.robots[1], 6.0, 7.0) < 0.2)
    assert len(fresh)
    assert fresh[0] * 0.005 < 0.3
    assert not air.robots[1].failed


@pytest.mark.parametrize(("kbit_s", "loss", "seeds"), [(128, 0.0, [4]), (512, 0.2, [4, 5, 6])])
def test_a_robot_that_joins_sees_a_picture_soon(kbit_s: float, loss: float, seeds: list[int]) -> None:
    """Within the airtime of a key frame and half a second; with losses in the median, as one may take its hello."""
    firsts = []
    for seed in seeds:
        air = link(receivers=2, kbit_s=kbit_s, loss=loss, seed=seed)
        late = air.robots[2]
        late.on = False
        air.run(5.26)
        late.on = True
        air.run(7.0)
        firsts.append(late.of(1)[0][0])
        numbers = [number_of(message) for _, message in late.of(1)]
        assert len(numbers) > 10
        assert numbers == sorted(set(numbers))
    assert median(firsts) < 5.26 + 0.5 + 0.25


def test_a_receiver_that_starts_again_sees_pictures_again() -> None:
    air = link()
    air.run(4.0)
    receiver = air.robots[1]
    receiver.start()
    receiver.seen.clear()
    air.run(8.0)
    assert receiver.of(1)[0][0] < 7.0
    assert len(receiver.of(1)) > 12


def test_a_camera_that_starts_again_is_seen_again() -> None:
    air = link()
    air.run(4.0)
    air.robots[0].start()
    air.robots[1].seen.clear()
    air.run(7.0)
    assert len(air.robots[1].of(1)) > 15


def lose_place(receiver: Robot) -> None:
    """Forget what was decoded."""
    receiver.receiver = FrameReceiver()
    for row in receiver.end.topics_of(1).values():
        receiver.receiver.announce((1, row.topic_id), row)
    receiver.seen.clear()


def test_a_receiver_that_lost_its_place_asks_for_a_key_frame() -> None:
    air = link(loss=0.1)
    air.run(4.0)
    receiver = air.robots[1]
    lose_place(receiver)
    air.run(6.0)
    assert receiver.failed
    assert receiver.of(1)[0][0] < 5.0
    assert len(receiver.of(1)) > 12


def test_one_that_lost_its_place_again_lacks_frames_until_the_next_key_frame_may_come_and_none_then() -> None:
    air = link(kbit_s=32, receivers=2)
    air.run(4.0)
    other, receiver = air.robots[1:]
    lose_place(receiver)
    air.run(5.0)
    asked = receiver.of(1)[0][0]
    lose_place(receiver)
    air.run(9.0)
    again = receiver.of(1)[0][0]
    assert asked + 1 < again < asked + KEY_S + 0.75
    assert receiver.failed
    assert all(isinstance(error, MissingFrameError) and now < again for now, error in receiver.failed)
    assert not other.failed


def test_one_that_cannot_follow_does_not_hold_others_back() -> None:
    air = link(receivers=2)
    rng = random.Random(3)
    good, bad = air.robots[1:]
    air.lost = lambda _, receiver: receiver is bad and rng.random() < 0.9
    air.run(8.0)
    assert len([now for now, _ in good.of(1) if now > 3]) > 5 * 10
    assert ages(good, 3, 8).mean() < 0.25


def test_without_reports_key_frames_come_in_a_period() -> None:
    air = link(loss=0.02)
    receiver = air.robots[1]
    air.lost = lambda robot, _: robot is receiver
    air.run(8.0)
    assert len([now for now, _ in receiver.of(1) if now > 3]) > 20


@pytest.mark.parametrize("bad", ["short", "zero", "resized"])
def test_a_bad_picture_is_counted_once_and_the_next_passes(bad: str) -> None:
    air = link()
    sender, receiver = air.robots
    good = picture(0)
    pictures = {
        "short": good[:-1000],
        "zero": scenes.write(IMAGE, **ZERO),
        "resized": scenes.image(scenes.view(0, 160, 120), "rgb8", 15),
    }
    air._feeds[0] = sender, CAMERA, FPS, lambda n: pictures[bad] if n == 15 else picture(n), 0
    air.run(3.0)
    refused = [event for event in sender.events if isinstance(event, Refused) and event.reason == Fate.DAMAGED]
    assert len(refused) == (bad != "resized")
    assert [number_of(message) for _, message in receiver.of(1)][-1] > 30
    assert not receiver.failed


def test_an_unknown_encoding_passes_exactly_and_is_named_once(caplog: pytest.LogCaptureFixture) -> None:
    air = link(kbit_s=2000)
    odd = [scenes.image(np.full((24, 32, 6), n, np.uint8), "rgb16", n) for n in range(60)]
    air._feeds[0] = air.robots[0], CAMERA, FPS, odd.__getitem__, 0
    air.run(3.0)
    assert len(air.robots[1].of(1)) > 30
    assert {message for _, message in air.robots[1].of(1)} <= set(odd)
    assert [record.message for record in caplog.records if "rgb16" in record.message] != []
    assert len([record for record in caplog.records if "rgb16" in record.message]) == 1


def pictures_of(air: Air) -> list[Any]:
    return [read(IMAGE, message) for _, message in air.robots[1].of(1)]


def test_the_options_of_a_camera_say_what_comes_out() -> None:
    """The option ``camera`` of a topic."""
    small = link(kbit_s=1000, size="160x120")
    small.run(2.0)
    assert {(shown.width, shown.height) for shown in pictures_of(small)} == {(160, 120)}
    few = link(fps=5.0)
    few.run(4.0)
    assert 3 * 4 <= len([now for now, _ in few.robots[1].of(1) if now > 1]) <= 3 * 5 + 1
    other = link(output="CompressedVideo")
    other.run(2.0)
    packets = [read(VIDEO, message) for _, message in other.robots[1].of(1)]
    assert {packet.format for packet in packets} == {"h264"}
    assert other.robots[1].types[1, CAMERA] == VIDEO
    assert CAMERA not in link(off=True).robots[0].sender
    assert CAMERA not in link(options={"codec": "zstd"}).robots[0].sender


@pytest.mark.parametrize("output", ["same", "CompressedImage", "CompressedVideo", "FFMPEGPacket"])
@pytest.mark.parametrize("name", ["camera/image", "camera/image/compressed"])
def test_camera_info_has_the_size_of_what_comes_out(output: str, name: str) -> None:
    air = link(size="160x120", output=output)
    air.robots[1].name = name
    air.run(2.0)
    receiver, info = air.robots[1].receiver, scenes.camera_info(320, 240)
    shown = read(CAMERA_INFO, receiver.scaled(1, "camera/camera_info", CAMERA_INFO, info))
    assert (shown.width, shown.height) == (160, 120)
    assert receiver.scaled(1, "rear/camera_info", CAMERA_INFO, info) == info
    assert receiver.scaled(2, "camera/camera_info", CAMERA_INFO, info) == info


def test_camera_info_is_as_it_came_once_the_camera_passes_exactly() -> None:
    receiver, told = FrameReceiver(), AnnouncedTopic(CAMERA, "camera/image", IMAGE, codec="frames")
    receiver.announce((1, CAMERA), told)
    info = scenes.camera_info(640, 480)
    receiver.decode((1, CAMERA), told.name, CodedTopic(IMAGE).encoder().encode(picture(0), 900).data, 0.0)
    assert receiver.scaled(1, "camera/camera_info", CAMERA_INFO, info) != info
    receiver.announce((1, CAMERA), told._replace(codec=""))
    assert receiver.scaled(1, "camera/camera_info", CAMERA_INFO, info) == info


def test_of_several_cameras_in_one_namespace_each_has_its_camera_info() -> None:
    receiver, info = FrameReceiver(), scenes.camera_info(320, 240)
    sizes = {"left_image_raw": 160, "left_image_rect": 320, "right_image": 320, "image_color": 320, "image": 160}
    encoders = {}
    for number, (name, width) in enumerate(sizes.items()):
        receiver.announce((1, number), AnnouncedTopic(number, f"eye/{name}", IMAGE, codec="frames"))
        options = {"camera": {"size": f"{width}x{width * 3 // 4}"}}
        encoders[number] = CodedTopic(IMAGE, options).encoder()

    def widths() -> list[int]:
        of = ("left_camera_info", "right_camera_info", "camera_info")
        return [read(CAMERA_INFO, receiver.scaled(1, f"eye/{name}", CAMERA_INFO, info)).width for name in of]

    for round in range(2):
        for number, name in enumerate(sizes):
            receiver.decode((1, number), f"eye/{name}", encoders[number].encode(picture(round), 900).data, 0.0)
            if round:
                assert widths() == [160, 320, 160], "whatever came last"
    receiver.decode((1, 7), "eye/left_image_raw", b"a picture that passes exactly", 0.0)
    assert widths() == [320, 320, 160]


def test_a_longest_rate_of_the_topic_is_heeded() -> None:
    air = link(options={"max_rate": 5.0})
    air.run(4.0)
    assert 3 * 4 <= len([now for now, _ in air.robots[1].of(1) if now > 1]) <= 3 * 5 + 1


def test_depth_comes_out_as_depth() -> None:
    rooms = [scenes.room(number, 160, 120) for number in range(30)]

    def error(kbit_s: float, **depth_image: Any) -> float:
        """Median of the errors of the newest image that came out, m; of those within 2 to 3 m."""
        air = link(kbit_s=kbit_s, options={"depth_image": depth_image})
        depths = [scenes.image((room * 1000).astype(np.uint16), "16UC1", n) for n, room in enumerate(rooms)]
        air._feeds[0] = air.robots[0], CAMERA, 10, lambda n: depths[min(n, 29)], 0
        air.run(3.0)
        shown = pictures_of(air)[-1]
        assert shown.encoding == "16UC1"
        found = shown.data.view(np.uint16).reshape(120, 160) / 1000
        truth = rooms[number_of(air.robots[1].of(1)[-1][1])]
        some = (truth > 2) & (truth < 3)
        return float(np.median(np.abs(found - truth)[some]))

    assert error(2000, mode="exact") <= 0.001
    assert error(2000, off=True) <= 0.001
    assert 0.001 < error(2000, mode="8") < 0.05
    assert error(256) < 0.1
    assert error(256, near=2.0, far=3.0) < error(256)


def test_what_is_said_of_a_topic() -> None:
    air = link()
    air.run(4.0)
    said = air.robots[0].sender.stats(CAMERA, air.now)
    assert said is not None
    assert said["frames"] > 40
    assert said["made"].startswith("H.264 of")
    pattern = r"camera/image: 3\.\d MB/s as it is, sent as 1[456] frames/s in \d+ kbit/s, 0\.1 s old"
    assert re.fullmatch(pattern, said["words"]), said["words"]
    rest = air.robots[0].sender.stats(CAMERA, air.now + 60)
    assert rest is not None
    assert rest["words"] == "camera/image: no message came in the last 2 s"


def test_two_cameras_share_what_is_free_by_weight() -> None:
    rows = [Topic(0, "camera/image", IMAGE), Topic(1, "rear/image", IMAGE, SendOptions(weight=3.0))]
    sender, receiver = Robot(1, Registry(rows), 256), Robot(2, None, 256)
    air = Air(sender, receiver)
    for topic_id in (0, 1):
        air.feed(sender, topic_id, 10, picture)
    air.run(5.0)
    sizes = [
        sum(len(e.payload) for e in sender.events if isinstance(e, Accepted) and e.topic_id == topic_id and e.now > 2)
        for topic_id in (0, 1)
    ]
    assert 2 < sizes[1] / sizes[0] < 4


def test_a_camera_that_shows_nothing_takes_no_share() -> None:
    def sent(*topics: Topic) -> int:
        sender = Robot(1, Registry(topics), 256)
        air = Air(sender, Robot(2, None, 256))
        air.feed(sender, 0, 10, picture)
        air.run(4.0)
        return sum(len(event.payload) for event in sender.events if isinstance(event, Accepted))

    front, rear = Topic(0, "front/image", IMAGE), Topic(1, "rear/image", IMAGE)
    assert sent(front, rear) == pytest.approx(sent(front), rel=0.05)


def test_options_change_while_it_is_sent() -> None:
    air = link()
    air.run(2.0)
    sender = air.robots[0]
    sender.sender.add(Topic(CAMERA, "camera/image", IMAGE, SendOptions(max_rate=3.0)))
    air.run(6.0)
    assert 8 <= len([now for now, _ in air.robots[1].of(1) if now > 3]) <= 10


def test_the_memory_for_topics_of_others_is_bounded() -> None:
    receiver, encoder = FrameReceiver(), CodedTopic(IMAGE).encoder()
    key_frame, following = (encoder.encode(picture(number), 900).data for number in range(2))
    keys = [(robot, topic) for robot in range(1, 4) for topic in range(20)]
    for key in keys:
        assert receiver.announce(key, AnnouncedTopic(key[1], f"image_{key[1]}", IMAGE, codec="frames")) == IMAGE
        receiver.decode(key, f"camera_{key[1]}/image", key_frame, 0.0)
    assert len(receiver._decoders) == len(receiver._sizes) == MOST_DECODERS < len(keys)
    receiver.decode(keys[-1], "camera/image", following, 0.0)
    with pytest.raises(MissingFrameError):
        receiver.decode(keys[0], "camera/image", following, 0.0)


def test_maps_need_no_package_of_video(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "av", None)
    monkeypatch.delitem(sys.modules, "gr_ros2.codecs.camera", raising=False)
    assert FrameReceiver().announce((1, 0), AnnouncedTopic(0, "map", GRID, codec="frames")) == GRID
    with pytest.raises(BackendMissingError, match="video"):
        FrameReceiver().announce((1, 0), AnnouncedTopic(0, "image", IMAGE, codec="frames"))


def test_a_thousand_frames_of_any_size_arrive_whole_and_in_order() -> None:
    sender, receiver = Robot(1, registry(off=True), 1000), Robot(2, None, 1000)
    air = Air(sender, receiver, loss=0.2)
    frames, rng = sender.end.frames, random.Random(1)
    frames.begin(CAMERA)
    receiver.receiver.decode = lambda *args: args[2]  # type: ignore[method-assign]
    air.run(0.5)
    sent = [b"first"]
    frames.submit(CAMERA, sent[0], air.now, air.now, key=True)
    for _ in range(1000):
        sent.append(rng.randbytes(min(9000, int(rng.expovariate(1 / 300)))))
        frames.submit(CAMERA, sent[-1], air.now, air.now, key=False)
        air.run(air.now + 0.005)
    air.run(air.now + 5)
    assert [message for _, message in receiver.of(1)] == sent
    assert not frames.progress(CAMERA, air.now).behind


def test_without_its_package_pictures_pass_as_they_are_and_a_line_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setitem(sys.modules, "av", None)
    air = link(kbit_s=4000)
    assert CAMERA not in air.robots[0].sender
    air.run(2.0)
    assert {message for _, message in air.robots[1].of(1)} <= {picture(number) for number in range(40)}
    assert len(air.robots[1].of(1)) > 2
    assert [record.message for record in caplog.records if "gr-ros2[video]" in record.message][1:] == []
    assert "pip install 'gr-ros2[video]'" in caplog.text


def test_a_picture_that_passes_exactly_is_repaired_however_long_it_takes() -> None:
    """And the next one does not end its repair."""
    air = link(loss=0.3, kbit_s=256)
    odd = [scenes.image(RNG.integers(0, 9, (90, 120, 6), np.uint8), "rgb16", number) for number in range(16)]
    air._feeds[0] = air.robots[0], CAMERA, 2, lambda n: odd[min(n, 15)], 0
    air.run(16.0)
    shown = [message for _, message in air.robots[1].of(1)]
    sent = [event for event in air.robots[0].events if isinstance(event, Accepted) and event.topic_id == CAMERA]
    assert len(shown) >= len(sent) - 1 >= 4
    assert set(shown) <= set(odd)


def test_a_picture_that_waited_out_an_outage_is_sent_although_none_followed() -> None:
    air = link()
    air.run(3.0)
    lost, air.lost = air.lost, lambda _, __: True
    air.run(4.0)
    last = picture(60)
    air._feeds[0] = air.robots[0], CAMERA, 0.01, lambda _: last, 0
    air.run(8.0)
    air.lost = lost
    air.run(9.0)
    assert number_of(air.robots[1].of(1)[-1][1]) == 60


def test_a_picture_that_waits_at_the_end_has_a_fate() -> None:
    air = link(kbit_s=64)
    sender = air.robots[0]
    air.run(2.0)
    for number in range(2):
        sender.sender.offer(CAMERA, picture(number), air.now)
    before = [event for event in sender.events if isinstance(event, Refused)]
    sender.sender.end()
    (last,) = [event for event in sender.events if isinstance(event, Refused)][len(before) :]
    assert last.reason == Fate.SUPERSEDED
    assert "ended" in last.detail
    assert sender.sender.next(air.now) is None


def test_a_camera_is_turned_off_and_on_while_it_is_seen() -> None:
    """Exact pictures from then on; then video again."""
    air = link(loss=0.2, kbit_s=1000)
    sender, receiver = air.robots
    small = [scenes.image(scenes.view(number, 160, 120), "rgb8", number) for number in range(181)]
    air._feeds[0] = sender, CAMERA, FPS, small.__getitem__, 0
    air.run(2.0)

    def changed(until: float, off: bool) -> list[bytes]:
        sender.change(SendOptions(camera={"off": off}, queue="fifo", queue_depth=2))
        before = len(receiver.seen)
        air.run(until)
        pictures = [message for _, key, message in receiver.seen[before:] if key[1] not in (ODOMETRY, SCAN)]
        numbers = [number_of(message) for message in pictures]
        assert numbers == sorted(set(numbers))
        exact = [message == small[number] for message, number in zip(pictures, numbers, strict=True)]
        assert exact == sorted(exact, reverse=not off), "what has left before comes before"
        return [message for message, passes in zip(pictures, exact, strict=True) if passes == off]

    for begin in (2.0, 7.0):
        assert len(changed(begin + 3, off=True)) >= 2
        assert len(changed(begin + 5, off=False)) > 20
    assert not receiver.failed
    assert len(receiver.end.topics_of(1)) == 4, "the same topic id each time"


def test_an_output_changes_while_it_is_seen() -> None:
    air = link()
    sender, receiver = air.robots
    air.run(3.0)
    sender.change(SendOptions(camera={"output": "CompressedVideo", "size": "160x120"}))
    before = len(receiver.of(1))
    air.run(6.0)
    assert receiver.types[1, CAMERA] == VIDEO
    assert {read(VIDEO, message).format for _, message in receiver.of(1)[before + 3 :]} == {"h264"}
    assert len(receiver.of(1)) - before > 30
    assert receiver.receiver._decoders[1, CAMERA, 0].size == (160, 120)


def test_a_picture_that_is_coded_while_the_camera_is_turned_off_has_a_fate() -> None:
    sender = Robot(1, registry(), 128)
    sender.sender.offer(CAMERA, picture(0), 0.0)
    job = sender.sender.next(0.0)
    assert job is not None
    sender.sender.offer(CAMERA, picture(1), 0.01)
    sender.change(SendOptions(camera={"off": True}))
    sender.sender.done(job, job.run(), 0.02)
    sender.change(SendOptions())
    sender.sender.offer(CAMERA, picture(2), 0.03)
    again = sender.sender.next(0.03)
    assert again is not None
    sender.sender.done(again, again.run(), 0.04)
    refused = [event for event in sender.events if isinstance(event, Refused)]
    assert [event.reason for event in refused] == [Fate.SUPERSEDED] * 2
    assert len([event for event in sender.events if isinstance(event, Accepted)]) == 1


def test_a_frame_that_is_too_long_is_counted_and_named_and_the_next_passes(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    air = link()
    sender, receiver = air.robots
    air.run(2.0)
    monkeypatch.setattr("gr_ros2.link.v1.outbox.MAX_MESSAGE", 100)
    air.run(3.0)
    monkeypatch.undo()
    seen = len(receiver.of(1))
    air.run(5.0)
    refused = [event for event in sender.events if isinstance(event, Refused) and event.reason == Fate.TOO_LARGE]
    assert len(refused) >= 4, "each is counted"
    assert len([record for record in caplog.records if "too large" in record.message]) == 1
    assert len(receiver.of(1)) - seen > 20
    assert not receiver.failed, "no frame came without the one before it"
    said = sender.sender.stats(CAMERA, air.now)
    assert said is not None and said["not_coded"] == len(refused)


def test_a_picture_that_no_receiver_would_make_is_not_sent(caplog: pytest.LogCaptureFixture) -> None:
    air = link(kbit_s=4000)
    sender, receiver = air.robots
    huge = scenes.image(np.zeros((2000, 2100, 6), np.uint8), "rgb16", 5)
    air._feeds[0] = sender, CAMERA, 5, lambda n: huge if n == 5 else picture(n), 0
    air.run(3.0)
    refused = [event for event in sender.events if isinstance(event, Refused) and event.reason == Fate.TOO_LARGE]
    assert len(refused) == 1
    assert str(len(huge)) in refused[0].detail
    assert len([record for record in caplog.records if "too large" in record.message]) == 1
    assert [number_of(message) for _, message in receiver.of(1)][-1] > 12
    assert not receiver.failed


def test_a_robot_in_between_shows_a_camera_on_as_one_of_its_own() -> None:
    """What a program of its graph publishes again is coded anew, within what that robot's air has left."""
    camera, between, far = Robot(1, registry(), 256), Robot(2, registry(), 128), Robot(3, None, 128)
    air = Air(camera, between, far)
    air.lost = lambda sender, receiver: {sender, receiver} == {camera, far}
    air.feed(camera, CAMERA, FPS, picture)
    take = between.take

    def taken(events: Any, now: float) -> None:
        before = len(between.seen)
        take(events, now)
        for _, key, message in between.seen[before:]:
            if key == (1, CAMERA):
                between.submit(CAMERA, message, now)

    between.take = taken  # type: ignore[method-assign]
    air.run(6.0)
    seen = [(now, number_of(message) / FPS) for now, message in far.of(2) if now > 2]
    assert len(seen) > 4 * 12
    assert np.mean([now - made for now, made in seen]) < 0.3
    assert not far.of(1)


def test_what_cannot_come_out_as_video_is_not_sent_where_video_comes_out(caplog: pytest.LogCaptureFixture) -> None:
    """Depth, and an encoding that is unknown: a subscriber of CompressedVideo could not read them."""
    air = link(output="CompressedVideo", kbit_s=1000)
    sender, receiver = air.robots
    others = {
        20: scenes.image(np.full((24, 32, 6), 9, np.uint8), "rgb16", 20),
        24: scenes.image((scenes.room(0, 64, 48) * 1000).astype(np.uint16), "16UC1", 24),
    }
    air._feeds[0] = sender, CAMERA, FPS, lambda n: others.get(n, picture(n)), 0
    air.run(4.0)
    assert {read(VIDEO, message).format for _, message in receiver.of(1)} == {"h264"}
    refused = [event for event in sender.events if isinstance(event, Refused) and event.reason == Fate.UNSUPPORTED]
    assert len(refused) == 2
    assert len([record for record in caplog.records if "is not sent" in record.message]) == 2
    assert not receiver.failed
    assert receiver.of(1)[-1][0] > 3.8
    forged = CodedTopic(IMAGE, {"camera": "off", "depth": "off"}).encoder().encode(others[20])
    with pytest.raises(DamagedError, match="comes out"):
        receiver.receiver.decode((1, CAMERA), "camera/image", forged.data, air.now)


def test_what_the_frames_of_robots_make_in_a_second_is_bounded() -> None:
    """A few bytes may say "the same as before" of millions of pixels."""
    receiver, pixels = FrameReceiver(), np.zeros((2160, 3840), np.uint8)
    for robot in range(10):
        receiver.announce((robot, 0), AnnouncedTopic(0, "image", IMAGE, codec="frames"))
    encoder = CodedTopic(IMAGE, {"camera": {"size": "full"}}).encoder()
    key, still = (encoder.encode(scenes.image(pixels, "mono8"), 90_000).data for _ in range(2))
    assert len(still) < 300

    def made(robots: Iterable[int], now: float) -> int:
        """Bytes of messages that come out of many frames at once."""
        found = 0
        for robot in robots:
            for _ in range(40):
                with suppress(CodecError):
                    found += len(receiver.decode((robot, 0), "image", key, now))
        return found

    assert MOST_BYTES_S <= made([1], 0.0) < 1.1 * MOST_BYTES_S
    with pytest.raises(CodecError, match="robot 1 make more than 256 MB"):
        receiver.decode((1, 0), "image", key, 0.0)
    assert receiver.decode((2, 0), "image", key, 0.0), "another robot is decoded"
    assert receiver.decode((1, 0), "image", key, 0.1)
    assert receiver.decode((1, 0), "image", still, 0.2)
    assert made(range(3, 10), 2.0) < 4.1 * MOST_BYTES_S
    with pytest.raises(CodecError, match="all robots make more than 1,024 MB"):
        receiver.decode((9, 0), "image", key, 2.0)
