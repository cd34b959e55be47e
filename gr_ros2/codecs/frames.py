"""Topics as chains of frames on a link: cameras, depth, maps, and clouds that fit the air.

:class:`FrameSender` decides when the newest message of each topic is coded and keeps the encoders, whoever runs them:
a thread of a link, or a simulation at once. :class:`FrameReceiver` keeps one decoder for each topic of each robot.

Invariants: sans-IO; encoding needs no lock, and one message of a topic is encoded at a time; every message that is
offered becomes a frame or is refused by name; a message that no codec takes passes exactly, and is named once; one that
cannot be coded ends nothing but itself.
"""

from __future__ import annotations

import logging
from collections import OrderedDict, deque
from collections.abc import Mapping
from math import inf
from typing import Any, NamedTuple

from gr_ros2.codecs.base import MAX_SIZE, Coded
from gr_ros2.codecs.messages import CAMERA_INFO, CLOUD
from gr_ros2.codecs.pull import FramePull, Pull, StatePull
from gr_ros2.codecs.topic import CODECS, OFF, CodedTopic, TopicDecoder, TopicEncoder
from gr_ros2.core.errors import BackendMissingError, CodecError, MissingFrameError
from gr_ros2.link.fates import Fate
from gr_ros2.link.frames import MARK, FrameSide
from gr_ros2.settings.fields import AUTO
from gr_ros2.settings.registry import PICTURES, Topic
from gr_ros2.wire import AnnouncedTopic

CODING_S = 0.008
"""s that coding takes: one of 640 × 480 pixels needs half of it, and the computer has more to do."""
MOST_DECODERS = 32
"""Topics of others that are decoded at a time; each may hold some pictures. The one that was used longest ago begins
anew with a key frame."""
MOST_BYTES_S = 256e6
"""Bytes of messages in a second that are made of one robot's frames, on average over a second: 250 bytes of video may
say "the same as before" of 8 million pixels, which takes 18 ms. It is more than a camera of 1920 × 1080 pixels at 30/s,
and keeps half a core busy."""
_TOGETHER, _ALL = 4, -1
"""Times as many of all robots together, and whose they are."""
_DAMAGED_BYTES = 1 << 23
"""Bytes that a damaged frame counts: whatever was wrong with it may have been found at its end."""
_BESIDE = ("image_raw", "image", "image_color", "image_mono")
"""Ends of the names of pictures that a CameraInfo beside them is of, the likeliest first."""
MOST_HELD = 1 << 28
"""Bytes of maps and the like of others that are kept, for what changes of them: of those used longest ago none are."""
_STATES = {CODECS["grid"].number, CODECS["growing"].number}
"""Codecs of messages of which the newest counts, however old it is."""
_SECONDS = 2.0
"""s over which what is said of a topic is a mean."""
_log = logging.getLogger(__name__)


class Job(NamedTuple):
    """A message to be encoded.

    :param encoder: whose ``encode`` it is for, without a lock
    :param sent: the topic
    """

    topic_id: int
    pull: Pull
    encoder: TopicEncoder
    sent: _Sent

    def run(self) -> Coded | CodecError:
        """The frame, or why there is none."""
        try:
            return self.encoder.encode(self.pull.message, self.pull.budget, self.pull.key)
        except CodecError as error:
            return error
        except (ValueError, OverflowError, MemoryError) as error:  # it contradicts itself
            return CodecError(f"image: {error}")


class _Sent:
    """A topic that is sent as frames."""

    def __init__(self, topic: Topic, coded: CodedTopic) -> None:
        self.name = topic.name
        self.use(topic, coded)
        self.is_map = not _STATES.isdisjoint(coded.codecs)
        self.is_cloud = topic.type_name == CLOUD
        self.pull: FramePull | StatePull = (StatePull if self.is_map else FramePull)(coding_s=CODING_S)
        self.limit(topic)
        self.said: set[str] = set()
        self.frames = self.failed = self.bytes = 0
        self._lately: deque[tuple[float, int, int]] = deque()
        """When, bytes that came, and bytes of a frame that was sent."""
        self.what = ""

    def use(self, topic: Topic, coded: CodedTopic) -> None:
        """Code from now on so, with a key frame first."""
        self.options, self.coded = _coding(topic), coded
        self.encoder = coded.encoder()

    def note(self, now: float, came: int = 0, frame: int = 0) -> None:
        """So many bytes came, or were sent."""
        self._lately.append((now, came, frame))
        while self._lately[0][0] < now - _SECONDS:
            self._lately.popleft()

    def lives(self, now: float) -> bool:
        """Whether messages have come lately."""
        return bool(self._lately) and self._lately[-1][0] >= now - _SECONDS

    def words(self, now: float, age_s: float) -> str:
        """What has become of the topic lately."""
        lately = [item for item in self._lately if item[0] >= now - _SECONDS]
        whole = sum(came for _, came, _ in lately) / _SECONDS
        frames = [frame for _, _, frame in lately if frame]
        rate = f"{whole / 1e6:.1f} MB/s" if whole >= 1e5 else f"{whole / 1e3:.1f} kB/s"
        return (
            f"{self.name}: {rate} as it is, sent as {len(frames) / _SECONDS:.0f} frames/s in "
            f"{sum(frames) / _SECONDS * 8e-3:.0f} kbit/s, {age_s:.1f} s old"
        )

    def limit(self, topic: Topic) -> None:
        """Heed the options of the topic that may change while it is sent."""
        options = topic.options
        fps = options.max_rate if options.camera.fps == AUTO else options.camera.fps
        self.weight, self.pull.period_s = options.weight, 1 / fps if fps else 0.0


class FrameSender:
    """The topics that one robot sends as frames.

    :param frames: of its endpoint
    """

    def __init__(self, frames: FrameSide) -> None:
        self._frames = frames
        self._sent: dict[int, _Sent] = {}

    def add(self, topic: Topic, *, latched: bool = False) -> bool:
        """Send a topic as frames if it is a camera, depth, a latched map or a cloud that is to fit the air, and its
        options do not say otherwise.
        Returns whether it is sent so. For one that is, its options may have changed.

        :param latched: whether its one publisher keeps its message for late joiners
        """
        known = self._sent.get(topic.topic_id)
        if known is not None:
            known.limit(topic)
            if known.options != _coding(topic) and (changed := coded_topic(topic)) is not None:
                known.use(topic, changed)
                self._begin(topic)
            return True
        coded = coded_topic(topic, latched=(latched or topic.latched) and not self._frames.relayed)
        if coded is None:
            return False
        self._sent[topic.topic_id] = _Sent(topic, coded)
        self._begin(topic)
        return True

    def _begin(self, topic: Topic) -> None:
        output = topic.options.camera.output
        self._frames.begin(topic.topic_id, "" if output == "same" else output)

    def change(self, before: Topic, after: Topic) -> None:
        """A topic has other options, and may have another topic id with them."""
        if not before.as_frames or after.as_frames:
            if before.topic_id in self._sent or before.topic_id != after.topic_id:
                self.add(after)
        elif (sent := self._sent.pop(before.topic_id, None)) is not None:
            if sent.pull.end():
                why = "the topic's options changed before the air was free for it"
                self._frames.refuse(before.topic_id, Fate.SUPERSEDED, why)
            self._frames.end(before.topic_id)

    def forget(self, topic_id: int) -> None:
        """Send no message of a topic so far to those who come."""
        if topic_id in self._sent and self._sent[topic_id].is_map:
            self._sent[topic_id].pull = StatePull(period_s=self._sent[topic_id].pull.period_s, coding_s=CODING_S)

    def __contains__(self, topic_id: int) -> bool:
        return topic_id in self._sent

    def offer(self, topic_id: int, message: bytes, now: float) -> None:
        """A message has come."""
        sent = self._sent[topic_id]
        sent.note(now, came=len(message))
        if sent.pull.offer(message, now):
            self._frames.refuse(topic_id, Fate.SUPERSEDED, "a newer one came before the air was free for it")

    def next(self, now: float) -> Job | None:
        """A message that is to be encoded now. ``done`` has to follow."""
        for topic_id, sent in self._sent.items():
            if sent.pull.waits(now):
                share = sent.weight / sum(
                    other.weight for other in self._sent.values() if other is sent or other.lives(now)
                )
                pull = sent.pull.pull(now, self._frames.progress(topic_id, now), share)
                if pull is not None:
                    return Job(topic_id, pull, sent.encoder, sent)
        return None

    def done(self, job: Job, made: Coded | CodecError, now: float) -> None:
        """What has become of a message."""
        sent = job.sent
        if job.encoder is not sent.encoder or self._sent.get(job.topic_id) is not sent:
            taken = False
            self._frames.refuse(job.topic_id, Fate.SUPERSEDED, "the topic's options changed while it was coded")
        elif isinstance(made, CodecError):
            taken = False
            sent.failed += 1
            self._frames.refuse(job.topic_id, Fate.DAMAGED, str(made))
        elif not (taken := self._taken(job, made, now)) and made.data[0] and not sent.is_map:
            sent.encoder = sent.coded.encoder()  # no frame may follow one that is not sent
        sent.pull.done(None if taken else job.pull)

    def _taken(self, job: Job, made: Coded, now: float) -> bool:
        """Whether a frame is sent. One of which no receiver makes a message is not."""
        sent, size = job.sent, len(job.pull.message)
        if not sent.coded.makes(made.data[0]):
            why = f"{made.said or 'it is no picture'}; it cannot come out as {sent.coded.output}"
            self._frames.refuse(job.topic_id, Fate.UNSUPPORTED, why)
            sent.failed += 1
            if why not in sent.said:
                sent.said.add(why)
                _log.warning("topic %s: is not sent: %s", sent.name, why)
            return False
        if size > MAX_SIZE and (sent.is_map or made.data[0] == 0):
            self._frames.refuse(job.topic_id, Fate.TOO_LARGE, f"{size} bytes; at most {MAX_SIZE}")
        elif self._frames.submit(job.topic_id, made.data, job.pull.came, now, key=self._is_key(job, made)):
            self._sent_off(sent, made, now)
            return True
        sent.failed += 1
        if Fate.TOO_LARGE not in sent.said:
            sent.said.add(Fate.TOO_LARGE)
            _log.warning("topic %s: a message of %d bytes is too large to be sent", sent.name, size)
        return False

    def _is_key(self, job: Job, made: Coded) -> bool:
        """Whether what was sent before is of no more use once a frame has left. Of clouds, each of which stands alone,
        all are repaired as long as somebody follows."""
        return job.pull.key if job.sent.is_cloud else made.before is None

    def _sent_off(self, sent: _Sent, made: Coded, now: float) -> None:
        """A frame is sent."""
        sent.frames, sent.what, sent.bytes = sent.frames + 1, made.said, sent.bytes + len(made.data)
        sent.note(now, frame=len(made.data))
        if sent.is_map:
            sent.encoder.confirmed(made.name)  # frames arrive in order
        elif made.data[0] == 0 and made.said not in sent.said:
            sent.said.add(made.said)
            what = "cells" if sent.is_cloud else "pictures"
            _log.warning("topic %s: passes exactly, not as %s: %s", sent.name, what, made.said)

    def end(self) -> None:
        """Code nothing more: messages that wait are not sent."""
        for topic_id, sent in self._sent.items():
            if sent.pull.end():
                self._frames.refuse(topic_id, Fate.SUPERSEDED, "sending ended before the air was free for it")

    def stats(self, topic_id: int, now: float) -> dict[str, Any] | None:
        """What is made of a topic: frames so far and their bytes, messages that could not be coded, and in words what
        the newest frame leaves out and what the topic has become lately; None for one that is not sent as frames."""
        sent = self._sent.get(topic_id)
        if sent is None:
            return None
        state = self._frames.progress(topic_id, now)
        words = {"made": sent.what, "words": sent.words(now, state.age)}
        return {"frames": sent.frames, "bytes": sent.bytes, "not_coded": sent.failed, **words}


class TimedCoder:
    """Encodes what a sender asks for in simulated time: at once, and each frame is there ``CODING_S`` later, so that
    equal runs have equal frames.

    :ivar due: when the next frame is there, s; infinite for none
    """

    def __init__(self, sender: FrameSender) -> None:
        self._sender = sender
        self._jobs: deque[tuple[float, Job, Coded | CodecError]] = deque()

    @property
    def due(self) -> float:
        return self._jobs[0][0] if self._jobs else inf

    def look(self, now: float) -> None:
        """Hand over what is there, and encode what is due now."""
        while self.due <= now:
            _, job, made = self._jobs.popleft()
            self._sender.done(job, made, now)
        while (following := self._sender.next(now)) is not None:
            self._jobs.append((now + CODING_S, following, following.run()))


def _coding(topic: Topic) -> tuple[Any, ...]:
    """Options with which another encoder is made."""
    camera = topic.options.camera
    return camera.off, camera.size, camera.output, topic.options.depth_image


def coded_topic(topic: Topic, *, latched: bool = False) -> CodedTopic | None:
    """How a topic is coded as frames; None if it is not. What has to be installed for it is said.

    :param latched: whether one publisher keeps its newest message for late joiners
    """
    states = (*CODECS["grid"].types, *CODECS["growing"].types)
    if latched and topic.type_name in states and topic.options.codec == AUTO:
        return CodedTopic(topic.type_name, {"growing": {}})
    if not topic.as_frames:
        return None
    options, depth = topic.options, topic.options.depth_image
    if topic.type_name == CLOUD:
        cloud = {"voxel": options.cloud.voxel, "range": options.cloud.range, "keep": options.cloud.keep}
        given = {name: value for name, value in cloud.items() if value != AUTO}
        return CodedTopic(CLOUD, {"cloud": given})
    chosen: dict[str, Mapping[str, Any] | str] = {
        "camera": OFF if options.camera.off else {"size": options.camera.size, "output_type": options.camera.output},
        "depth": OFF if depth.off else {"mode": depth.mode, "near": depth.near, "far": depth.far},
    }
    coded = CodedTopic(topic.type_name, chosen)
    if coded.missing:
        _log.warning("topic %s: passes as it is, and is not made small: %s", topic.name, coded.missing)
        return None
    return coded


def frames_output(told: AnnouncedTopic) -> str | None:
    """The option ``output`` of a topic that comes as frames; None if it does not."""
    mark, _, output = told.codec.partition(" ")
    return (output or "same") if mark == MARK else None


class FrameReceiver:
    """The frames of other robots to messages.

    :param max_size: bytes of the largest message that is made
    """

    def __init__(self, max_size: int = MAX_SIZE) -> None:
        self._max_size = max_size
        self._topics: dict[tuple[int, int], tuple[str, str, CodedTopic]] = {}
        self._shared: dict[tuple[str, str], CodedTopic] = {}
        """Some of these, by type and output: topics share them, since others may announce many."""
        self._left: dict[int, tuple[float, float]] = {}
        """Bytes of messages that may be made of each robot's frames, at a time in s."""
        self._decoders: OrderedDict[tuple[int, int], TopicDecoder] = OrderedDict()
        """Those that were used last, the newest last."""
        self._sizes: dict[tuple[int, str], tuple[int, int] | None] = {}
        """Width and height of the newest picture of each camera of a robot; None for one that has its own size. Only of
        the cameras that were used last, the newest last."""

    def announce(self, key: tuple[int, int], told: AnnouncedTopic) -> str:
        """A robot has announced a topic. Returns the type of the messages that come out.

        :param key: of the robot and the topic
        :raises ConfigError: for an output that is not known here
        :raises BackendMissingError: when what decodes it is not installed
        """
        output = frames_output(told)
        if output is None:
            if self._topics.pop(key, None):
                self._sizes.pop((key[0], _camera(told.name)), None)
            return told.type_name
        if key not in self._topics or self._topics[key][:2] != (told.type_name, output):
            coded = self._shared.get((told.type_name, output))
            if coded is None:
                coded = CodedTopic(told.type_name, {"camera": {"output_type": output}, "growing": {}})
                if len(self._shared) == MOST_DECODERS:
                    self._shared.clear()
                self._shared[told.type_name, output] = coded
            if coded.missing:
                raise BackendMissingError(f"topic {told.name} comes as video: {coded.missing}")
            self._topics[key] = told.type_name, output, coded
            self._decoders.pop(key, None)
        return self._topics[key][2].output

    def decode(self, key: tuple[int, int], name: str, payload: bytes, now: float) -> bytes:
        """The message of a frame, and any other as it is.

        :param name: of its topic
        :raises CodecError: the frame before is missing, or it is damaged, or its robot's frames make more messages than
            ``MOST_BYTES_S``
        """
        camera = key[0], _camera(name)
        if key not in self._topics:
            self._sizes.pop(camera, None)  # of the same camera as video
            return payload
        left = {whose: self._allowed(whose, now) for whose in (key[0], _ALL)}
        if min(left.values()) < 0:
            who = f"robot {key[0]} make" if left[key[0]] < 0 else "all robots make"
            most = f"{(MOST_BYTES_S if left[key[0]] < 0 else _TOGETHER * MOST_BYTES_S) / 1e6:,.0f} MB"
            raise CodecError(f"frames of {who} more than {most} of messages in a second")
        decoder = self._decoders.setdefault(key, self._topics[key][2].decoder(self._max_size))
        self._decoders.move_to_end(key)
        if len(self._decoders) > MOST_DECODERS:
            self._decoders.popitem(last=False)
        while len(self._decoders) > 1 and sum(each.held for each in self._decoders.values()) > MOST_HELD:
            self._decoders.popitem(last=False)
        made = _DAMAGED_BYTES
        try:
            message = decoder.decode(payload)
            made = len(message)
        except MissingFrameError:
            made = 0
            raise
        finally:
            self._left |= {whose: (bytes_left - made, now) for whose, bytes_left in left.items()}
        self._sizes.pop(camera, None)
        if self._topics[key][0] in PICTURES:
            self._sizes[camera] = decoder.size
        if len(self._sizes) > MOST_DECODERS:
            del self._sizes[next(iter(self._sizes))]
        return message

    def _allowed(self, whose: int, now: float) -> float:
        """Bytes of messages that may be made of the frames of a robot, or of all, now."""
        most = MOST_BYTES_S * (_TOGETHER if whose == _ALL else 1)
        left, at = self._left.get(whose, (most, now))
        return min(left + (now - at) * most, most)

    def scaled(self, src_id: int, name: str, type_name: str, message: bytes) -> bytes:
        """A CameraInfo for the picture beside it, as large as that came out; any other message as it is.

        Of several pictures beside it, it fits the first of ``_BESIDE``, or else the first by name.
        """
        if type_name != CAMERA_INFO:
            return message
        place, _, own = name.rpartition("/")
        begin = f"{place}/{own.removesuffix('camera_info')}".lstrip("/")
        beside = {
            camera.rpartition("/")[2]: size
            for (robot, camera), size in self._sizes.items()
            if robot == src_id and camera.startswith(begin) and camera.rpartition("/")[0] == place
        }
        size = beside[min(beside, key=_rank)] if beside else None
        if size is None:
            return message
        from gr_ros2.codecs.camera import scaled_camera_info

        return scaled_camera_info(message, *size)


def _camera(name: str) -> str:
    """The name of a camera, without that of its transport: its CameraInfo is beside it."""
    return name.removesuffix("/compressed").removesuffix("/compressedDepth")


def _rank(name: str) -> tuple[int, str]:
    """The place of a picture among those beside a CameraInfo."""
    known = [place for place, end in enumerate(_BESIDE) if name.endswith(end)]
    return min(known, default=len(_BESIDE)), name
