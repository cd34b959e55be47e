"""A camera over two links with a PHY between them: pictures, odometry beside them, a receiver that starts again."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("zmq", reason="needs pyzmq")
from gr_ros2.cli.link import _live
from gr_ros2.codecs.messages import CAMERA_INFO, IMAGE, read
from gr_ros2.link.v1.frames import SentFrames
from gr_ros2.middleware import Qos
from gr_ros2.middleware.memory import MemoryMiddleware
from gr_ros2.observe.observers import RunObservers
from gr_ros2.radio.live_settings import LiveSettings
from gr_ros2.radio.robot_link import RobotLink
from tests.codecs import scenes
from tests.domains import domain
from tests.radio.robots import config
from tests.waiting import wait_for

QOS = Qos("best_effort", "volatile", 5)
SENSED, SEEN = "/robot_1/camera/image", "/rx_robot_1/camera/image"


class Camera:
    """A camera of a robot's graph: 15 pictures/s of a scene in motion, in a thread."""

    def __init__(self, number: int, width: int = 320) -> None:
        self._size = width, width * 3 // 4
        self._graph = MemoryMiddleware(domain_id=domain(number))
        self._images = self._graph.advertise(SENSED, IMAGE, QOS)
        self._infos = self._graph.advertise(SENSED.replace("image", "camera_info"), CAMERA_INFO, QOS)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def _run(self) -> None:
        pictures = [scenes.view(number, *self._size) for number in range(30)]
        number = 0
        while not self._stop.wait(1 / 15):
            self._images.publish(scenes.image(pictures[number % 30], "rgb8", number))
            self._infos.publish(scenes.camera_info(*self._size, number))
            number += 1

    def __enter__(self) -> Camera:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()
        self._graph.close()


@contextmanager
def link(number: int, tmp_path: Path, observers: RunObservers | None = None, **values: Any) -> Iterator[RobotLink]:
    """A robot's end over a link of 250 kBd, as long as it runs."""
    own, other = (f"ipc://{tmp_path}/{end}" for end in (number, 3 - number))
    phy = {"name": "psk", "sample_rate": 500e3, "options": {"lengths": "any"}}
    front_end = {"name": "zmq", "bind": own, "connect": [other]}
    found = {"registry": "", "packet_len": 220, "phy": phy, **values}
    made = RobotLink(config(number, front_end, **found), observer=observers)
    try:
        if observers is not None:
            observers.run_started(_live(made))
        made.start()
        yield made
    finally:
        made.stop()


class Watcher:
    """What a program of robot 2 gets of pictures and of what the camera says of itself."""

    def __init__(self, type_name: str = IMAGE) -> None:
        self.pictures: list[bytes] = []
        self.infos: list[bytes] = []
        self._graph = MemoryMiddleware(domain_id=domain(2))
        self._graph.subscribe(SEEN, type_name, QOS, self.pictures.append)
        self._graph.subscribe(SEEN.replace("image", "camera_info"), CAMERA_INFO, QOS, self.infos.append)

    def has(self, number: int) -> bool:
        return len(self.pictures) > number

    def close(self) -> None:
        self._graph.close()


@pytest.fixture
def watcher() -> Any:
    made = Watcher()
    yield made
    made.close()


def number_of(message: bytes) -> int:
    stamp = read(IMAGE, message).header.stamp
    return round((stamp.sec - 1_700_000_000) * 10 + stamp.nanosec / 1e8)


@pytest.mark.real_time
def test_pictures_cross_a_link_as_video(tmp_path: Path, watcher: Watcher) -> None:
    with Camera(1), link(1, tmp_path) as one, link(2, tmp_path, topics=[]):
        wait_for(lambda: len(watcher.pictures) > 60, "pictures", progress=lambda: len(watcher.pictures))
        numbers = [number_of(data) for data in watcher.pictures]
        assert numbers == sorted(set(numbers))
        words = one.source.stats()["topics"][SENSED]["frames"]["words"]
        assert words.startswith("camera/image: 3."), words
        sizes = {(shown.width, shown.height) for shown in (read(IMAGE, data) for data in watcher.pictures[-30:])}
        wait_for(lambda: (read(CAMERA_INFO, watcher.infos[-1]).width, 0) in {(w, 0) for w, _ in sizes}, "its size")


@pytest.mark.real_time
def test_a_camera_is_turned_off_and_on_while_it_is_seen(tmp_path: Path, watcher: Watcher) -> None:
    made = [read(IMAGE, scenes.image(scenes.view(number, 80, 60), "rgb8")).data.tobytes() for number in range(30)]
    with Camera(1, 80), link(1, tmp_path) as one, link(2, tmp_path, topics=[]):
        live = LiveSettings(one.source, one.sink)
        for value in ("off", {}) * 2:
            live.change("topics.camera/image.camera", value)
            begin = len(watcher.pictures)

            def comes(exact: bool = value == "off", begin: int = begin) -> bool:
                return exact in [read(IMAGE, data).data.tobytes() in made for data in watcher.pictures[begin:]]

            wait_for(comes, f"pictures with camera: {value}")


@pytest.mark.real_time
@pytest.mark.parametrize("missed", [0, 1])
def test_an_operator_who_comes_late_sees_the_video_of_a_live_link(
    tmp_path: Path, missed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where what asks for a key frame is lost."""
    pytest.importorskip("foxglove", reason="needs foxglove-sdk")
    from gr_ros2.dashboard.foxglove import FoxgloveServer
    from tests.dashboard.test_foxglove import Client

    asked: list[int] = []
    ask = SentFrames.lost

    def lost(self: SentFrames, src_id: int, topic_id: int) -> None:
        asked.append(topic_id)
        if len(asked) > missed:
            ask(self, src_id, topic_id)

    monkeypatch.setattr(SentFrames, "lost", lost)
    with FoxgloveServer("127.0.0.1", 0) as server, Camera(1, 80):
        observers = RunObservers([server], threaded=True)
        with link(1, tmp_path), link(2, tmp_path, observers, topics=[]):
            name = f"{SEEN}/video"
            wait_for(lambda: name in server._channels, "its channel")
            client = Client(server.port)

            def keys() -> list[bytes]:
                return [data for topic, data in client.seen if topic == name and b"\0\0\0\1\x67" in data]

            client.watch(lambda: bool(keys()))
        observers.run_ended(None)


@pytest.mark.real_time
def test_a_receiver_that_starts_again_sees_again(tmp_path: Path, watcher: Watcher) -> None:
    with Camera(1), link(1, tmp_path):
        for _ in range(2):
            before = len(watcher.pictures)
            with link(2, tmp_path, topics=[]):
                wait_for(partial(watcher.has, before + 15), "pictures", progress=lambda: len(watcher.pictures))
