"""Chains of frames over the air, against a robot that has the key, and against anybody where there is none: tables that
say any topic comes as frames, frames that are forged, cut, out of order or of another start, and a camera of ours whose
receivers ask, report and vanish as they like.

The endpoint and the decoders raise nothing but what a link counts; decoders, sizes and frames that wait are bounded; a
camera makes a key frame in 2 s at most, whatever others say.
"""

from __future__ import annotations

import random
from collections.abc import Sequence
from functools import cache, partial
from typing import cast

from fuzz.insider import STARTS, Robot, Script
from fuzz.loop import main, work
from gr_ros2.codecs import CODECS
from gr_ros2.codecs.frames import FrameSender, TimedCoder
from gr_ros2.codecs.messages import CLOUD, GRID, IMAGE
from gr_ros2.codecs.pull import KEY_S
from gr_ros2.codecs.received_frames import MOST_DECODERS, FrameReceiver
from gr_ros2.core.errors import BackendMissingError, CodecError, ConfigError
from gr_ros2.gr.factory import message_codec
from gr_ros2.link import AirPacket
from gr_ros2.link.events import Accepted, Announced, Delivered, ReceiverEvent
from gr_ros2.link.message_codec import FRAME
from gr_ros2.link.v1.endpoint import EndpointV1
from gr_ros2.link.v1.endpoint_settings import Settings
from gr_ros2.link.v1.sealing import Keys, SealMode
from gr_ros2.settings.config import CloudOptions, SendOptions
from gr_ros2.settings.registry import Registry, Topic
from gr_ros2.wire import v1
from gr_ros2.wire.control import Ask, Control, Report
from gr_ros2.wire.table import AnnouncedTopic, write_table
from tests.codecs import scenes
from tests.codecs.samples import SAMPLES

PACKET_LEN = 1024
MOST_PACKETS = 80
MOST_LINES = 150_000
"""Lines of Python that one packet, what is decoded of it and the answer may take; FFmpeg's work is bounded by sizes."""
MOST_WAITING = 64
"""Frames of a topic that wait, or that somebody lacks."""
_OWN, _BOOT = 9, 7 << 32 | 70
_KEY = bytes(range(32))
_MODES: tuple[SealMode, ...] = ("none", "authenticate", "encrypt")
_WAITS_S = (0.0, 0.001, *[0.02] * 12, 0.1, 0.1, 0.3, 0.6, 2.0, 11.0)
_TYPES = (IMAGE, IMAGE, CLOUD, GRID, "sensor_msgs/msg/CompressedImage", "std_msgs/msg/String", "")
_CODECS = ("frames", "frames", "frames", "frames CompressedVideo", "frames FFMPEGPacket", "frames x", "auto", "")
CAMERA, MAP, POINTS = range(3)


class FrameRobot(Robot):
    """One that sends frames and asks for them."""

    def parts(self, script: Script, room: int) -> list[v1.EntryV1]:
        found: list[v1.EntryV1] = []
        for _ in range(1 + script.byte() % 3):
            kind, topic_id = script.byte() % 8, script.byte() % 4
            if kind == 0:
                found.append(v1.Part(v1.TABLE_TOPIC, self._table(script)[: room - 3]))
                continue
            payload = FRAME + self._frame(script) if kind < 7 else script.bytes(60) or b"x"
            if kind < 6:
                found.append(v1.Part(topic_id, payload[: room - 8], coded=script.byte() % 8 > 0))
            else:
                offset, back = script.number(), script.byte() % 4
                found.append(v1.Part(topic_id, payload[:200], back, offset, script.byte() & 1 > 0, coded=True))
        return found

    def control(self, script: Script, echo: bytes) -> Control:
        kind = script.byte() % 4
        if kind == 0:
            return Ask(_OWN, bytes([script.byte() % 4 for _ in range(1 + script.byte() % 3)]))
        if kind == 1:
            mask = int.from_bytes(bytes([script.byte() for _ in range(8)]), "big")
            return Report(_OWN, _BOOT & 0xFFFF, script.byte(), mask, script.byte() & 1 > 0, script.byte() % 128, None)
        return super().control(script, echo)

    @staticmethod
    def _table(script: Script) -> bytes:
        rows = []
        for topic_id in range(1 + script.byte() % 4):
            type_name, codec = script.pick(_TYPES), script.pick(_CODECS)
            name = script.pick(("camera/image", "camera/camera_info", "map", "a/b/c", ""))
            in_order, latched = script.byte() & 1 > 0, script.byte() % 8 == 0
            rows.append(AnnouncedTopic(topic_id, name, type_name, 2, in_order, latched, 1, codec))
        return write_table(rows)

    @staticmethod
    def _frame(script: Script) -> bytes:
        frames = _frames()
        data = bytearray(frames[script.byte() % len(frames)])
        for _ in range(script.pick((0, 0, 0, 1, 3))):
            data[script.byte() * len(data) // 256] ^= 1 << script.byte() % 8
        if script.byte() % 8 == 0:
            del data[script.byte() * len(data) // 256 :]
        return bytes(data)


@cache
def _frames() -> tuple[bytes, ...]:
    """Frames of all samples, those of a sample in the order of their chain."""
    found = []
    for sample in SAMPLES.values():
        encoder = sample.topic().encoder()
        for message in sample.messages()[:3]:
            coded = encoder.encode(message, min(sample.budget or 300, 300))
            encoder.confirmed(coded.name)
            found.append(coded.data)
    return tuple(data for data in found if len(data) < PACKET_LEN - 60)


@cache
def _offers(topic_id: int) -> Sequence[bytes]:
    if topic_id == CAMERA:
        return [scenes.image(scenes.view(number, 64, 48), "rgb8", number) for number in range(8)]
    if topic_id == MAP:
        return scenes.exploring(4, 100)
    return [scenes.cloud(scenes.street(number, 4, 90), number=number) for number in range(4)]


class Victim:
    """A robot with a camera, a map and a cloud, which hears others."""

    def __init__(self, mode: SealMode) -> None:
        rows = [
            Topic(CAMERA, "camera/image", IMAGE),
            Topic(MAP, "map", GRID, SendOptions(durability="transient_local")),
            Topic(POINTS, "points", CLOUD, SendOptions(cloud=CloudOptions(voxel=0.1, fit=True))),
        ]
        topics, known = Registry(rows), message_codec()
        settings = Settings(
            _OWN,
            packet_len=PACKET_LEN,
            any_length=True,
            max_sources=3,
            max_source_bytes=1 << 16,
            packet_s=lambda: 0.02,
        )
        self.events: list[Accepted] = []
        self.end = EndpointV1(
            topics,
            settings,
            boot=_BOOT,
            keys=Keys((_KEY,) if mode != "none" else (), mode),
            codec=message_codec(topics),
            decoder_for=lambda rows: known.of(
                [Topic(row.topic_id, row.name, row.type_name) for row in rows],
                {row.topic_id: row.codec for row in rows},
            ),
            save=lambda *_: None,
            observer=lambda event: self.events.append(event) if isinstance(event, Accepted) else None,
        )
        self.end.pace.use_credit()
        self.sender, self.receiver = FrameSender(self.end.frames), FrameReceiver(1 << 20)
        for topic in topics:
            assert self.sender.add(topic)
        self.coder = TimedCoder(self.sender)
        self.shown = self.echo = b""

    def step(self, data: bytes, now: float, offered: int) -> None:
        """Take a packet, offer a message of each topic, send what may leave."""
        self._take(self.end.receive(AirPacket(data, now), now) + self.end.handle_timeout(now), now)
        for topic_id in (CAMERA, MAP, POINTS):
            if offered % (1, 5, 3)[topic_id] == 0:
                self.sender.offer(topic_id, _offers(topic_id)[offered % 4], now)
        self.coder.look(now)
        for _ in range(2):
            self.end.pace.credit()
            sent = self.end.next_packet(now)
            repair = None if sent is None else cast("v1.PacketV1", sent.packet).repair
            if sent is not None and repair is not None and repair.clear:
                self.echo = sent.data[-4:]

    def _take(self, events: Sequence[ReceiverEvent], now: float) -> None:
        for event in events:
            if isinstance(event, Announced):
                for told in event.topics:
                    try:
                        self.receiver.announce((event.src_id, told.topic_id), told)
                    except (ConfigError, BackendMissingError):
                        continue
            elif isinstance(event, Delivered):
                key = event.src_id, event.topic_id
                try:
                    assert len(self.receiver.decode(key, "camera/image", event.payload, now)) <= 1 << 20
                except CodecError:
                    self.end.frames.lost(*key)

    def check(self, now: float) -> None:
        assert len(self.receiver._decoders) <= MOST_DECODERS
        assert len(self.receiver._sizes) <= MOST_DECODERS
        for topic_id, sent in self.end.frames.sent.items():
            assert len(sent) <= MOST_WAITING, f"{len(sent)} frames of topic {topic_id}"
            assert len(self.end.messages.sent[topic_id].queue) <= MOST_WAITING
            assert sum(len(message.numbers) for message in sent) <= 16 * MOST_WAITING
        assert all(self.sender.stats(topic_id, now) for topic_id in (CAMERA, MAP, POINTS))


def _is_key(payload: bytes) -> bool:
    return payload[:1] == bytes([CODECS["camera"].number]) and payload[1] < 0x80


def frames(data: bytes) -> None:
    """A script: mode, then the packets of the others."""
    script = Script(data)
    mode = script.pick(_MODES)
    victim = Victim(mode)
    robots: dict[tuple[int, int], Robot] = {}
    now = 0.0
    for step in range(MOST_PACKETS):
        if script.over:
            break
        name = script.pick(STARTS)
        robot = robots.setdefault(name, FrameRobot(*name, mode, slots=False, packet_len=PACKET_LEN))
        packet = robot.packet(script, victim.echo or bytes(4))
        now += script.pick(_WAITS_S)
        lines, _ = work(partial(victim.step, packet, now, step))
        assert lines < MOST_LINES, f"{lines} lines"
        victim.check(now)
    keys = sum(event.topic_id == CAMERA and _is_key(event.payload) for event in victim.events)
    assert keys <= now / KEY_S + 2, f"{keys} key frames in {now:.1f} s"


def corpus() -> list[bytes]:
    """Scripts of any packets, and of many tables and frames."""
    rng = random.Random(9)
    found = [b"", bytes(300)]
    for mode in range(3):
        for _ in range(6):
            found.append(bytes((mode,)) + rng.randbytes(2500))
    return found


if __name__ == "__main__":
    main(frames, corpus())
