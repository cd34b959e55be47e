"""Robots with the engine of a link on a narrow full-duplex air, in simulated time: a camera, odometry and a scan."""

from __future__ import annotations

import heapq
import random
from collections.abc import Callable, Hashable, Iterable
from dataclasses import dataclass, field
from typing import Any

from gr_ros2.codecs.frames import FrameSender, TimedCoder
from gr_ros2.codecs.messages import IMAGE
from gr_ros2.codecs.received_frames import FrameReceiver
from gr_ros2.core.errors import CodecError
from gr_ros2.gr.factory import message_codec
from gr_ros2.link import AirPacket
from gr_ros2.link.events import Announced, Delivered
from gr_ros2.link.queues import PublisherQos
from gr_ros2.link.v1.endpoint import EndpointV1
from gr_ros2.link.v1.endpoint_settings import Settings
from gr_ros2.settings.config import SendOptions
from gr_ros2.settings.registry import Registry, Topic

CAMERA, ODOMETRY, SCAN = range(3)
STEP_S = 0.001
PACKET_LEN = 220


@dataclass(eq=False)
class Robot:
    """One robot, and what it has seen: when, and the message, of each topic of each robot."""

    number: int
    topics: Registry | None
    kbit_s: float
    any_length: bool = True
    hears: bool = True
    boot: int = 1
    name: str = "camera/image"
    seen: list[tuple[float, tuple[int, int], bytes]] = field(default_factory=list)
    types: dict[tuple[int, int], str] = field(default_factory=dict)
    names: dict[tuple[int, int], str] = field(default_factory=dict)
    failed: list[tuple[float, CodecError]] = field(default_factory=list)
    events: list[Any] = field(default_factory=list)
    on: bool = True
    free: float = 0.0

    def __post_init__(self) -> None:
        self.start()

    def start(self) -> None:
        """Start, or start again."""
        settings = Settings(
            self.number,
            packet_len=PACKET_LEN,
            any_length=self.any_length,
            hears=self.hears,
            packet_s=lambda: PACKET_LEN * 8e-3 / self.kbit_s,
        )
        known = message_codec()
        self.end = EndpointV1(
            self.topics,
            settings,
            boot=self.boot,
            codec=message_codec(self.topics) if self.topics else None,
            decoder_for=lambda rows: known.of(
                [Topic(row.topic_id, row.name, row.type_name) for row in rows],
                {row.topic_id: row.codec for row in rows},
            ),
            observer=self.events.append,
        )
        self.end.pace.use_credit()
        self.sender, self.receiver = FrameSender(self.end.frames), FrameReceiver()
        for topic in self.topics or ():
            self.sender.add(topic)
        self.camera = self.topics[CAMERA] if self.topics else Topic(CAMERA, "", "")
        self.boot += 1
        self.coder = TimedCoder(self.sender)

    def published_by(self, publishers: int, topic_id: int = 0) -> None:
        """So many publish a latched topic now."""
        self.end.messages.follow(topic_id, PublisherQos(latched=True, count=publishers, keeps=publishers))
        self.sender.follow(topic_id, publishers)

    def submit(self, topic_id: int, message: bytes, now: float, publisher: Hashable = None) -> None:
        topic_id = self.camera.topic_id if topic_id == CAMERA else topic_id
        changed = self.sender.changed(topic_id, message)
        if changed is not None:
            self.sender.take(changed, now)
            self.coder.look(now)
        elif topic_id in self.sender:
            self.sender.offer(topic_id, message, now, publisher)
            self.coder.look(now)
        else:
            self.end.messages.submit(topic_id, message, now, publisher=publisher)

    def change(self, options: SendOptions) -> None:
        """Give the camera other options."""
        before = self.camera
        _, self.camera = self.end.messages.change(before.topic_id, options)
        self.sender.change(before, self.camera)

    def receive(self, data: bytes, now: float) -> None:
        self.take(self.end.receive(AirPacket(data), now), now)

    def take(self, events: Iterable[Any], now: float) -> None:
        for event in events:
            if isinstance(event, Announced):
                for row in event.topics:
                    self.names[event.src_id, row.topic_id] = self.name if "camera" in row.name else row.name
                    self.types[event.src_id, row.topic_id] = self.receiver.announce((event.src_id, row.topic_id), row)
            elif isinstance(event, Delivered):
                key = event.src_id, event.topic_id
                try:
                    self.seen.append((now, key, self.receiver.decode(key, self.names.get(key, ""), event.payload, now)))
                except CodecError as error:
                    self.failed.append((now, error))
                    self.end.frames.lost(*key)

    def of(self, src_id: int, topic_id: int = CAMERA) -> list[tuple[float, bytes]]:
        return [(now, message) for now, key, message in self.seen if key == (src_id, topic_id)]


class Air:
    """Robots that hear each other, each over a channel of its own.

    :param lost: tells whether a packet of a robot is lost at another one
    """

    def __init__(self, *robots: Robot, loss: float = 0.0, seed: int = 1, delay_s: float = 0.005) -> None:
        self.robots, self.now, self.delay_s = list(robots), 0.0, delay_s
        rng = random.Random(seed)
        self.lost: Callable[[Robot, Robot], bool] = lambda _, __: rng.random() < loss
        self._under_way: list[tuple[float, int, Robot, bytes]] = []
        self._count = 0
        self._feeds: list[tuple[Robot, int, float, Callable[[int], bytes], int]] = []

    def feed(self, robot: Robot, topic_id: int, rate: float, message: Callable[[int], bytes]) -> None:
        """Give a robot so many messages/s of a topic."""
        self._feeds.append((robot, topic_id, rate, message, int(self.now * rate)))

    def run(self, until: float) -> None:
        while self.now < until:
            self.now += STEP_S
            self._step(self.now)

    def _step(self, now: float) -> None:
        for place, (robot, topic_id, rate, message, count) in enumerate(self._feeds):
            if robot.on and count / rate <= now:
                robot.submit(topic_id, message(count), now)
            if count / rate <= now:
                self._feeds[place] = robot, topic_id, rate, message, count + 1
        while self._under_way and self._under_way[0][0] <= now:
            _, _, sender, data = heapq.heappop(self._under_way)
            for other in self.robots:
                if other is not sender and other.on and not self.lost(sender, other):
                    other.receive(data, now)
                    other.coder.look(now)
        for robot in self.robots:
            if not robot.on:
                continue
            if (due := robot.end.next_timeout()) is not None and due <= now:
                robot.take(robot.end.handle_timeout(now), now)
            robot.coder.look(now)
            while robot.free <= now:
                if robot.end.pace.out_of_credit:
                    robot.end.pace.credit(1, robot.free)
                at = robot.end.next_departure()
                if not robot.end.urgent and (at is None or at > now):
                    break
                if (sent := robot.end.next_packet(now)) is None:
                    break
                robot.free = max(robot.free, now - STEP_S) + len(sent.data) * 8e-3 / robot.kbit_s
                self._count += 1
                heapq.heappush(self._under_way, (robot.free + self.delay_s, self._count, robot, sent.data))
                robot.coder.look(now)


def registry(**camera: Any) -> Registry:
    """A camera with such options, odometry, a scan."""
    options = camera.pop("options", {})
    camera_options = SendOptions(**({"camera": camera} if camera else {}), **options)
    return Registry(
        [
            Topic(CAMERA, "camera/image", (options and options.get("type", IMAGE)) or IMAGE, camera_options),
            Topic(ODOMETRY, "odom", "std_msgs/msg/String", SendOptions(queue="latest", codec="none")),
            Topic(SCAN, "scan", "std_msgs/msg/String", SendOptions(queue="latest", codec="none")),
        ]
    )
